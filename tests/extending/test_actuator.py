"""An actuator of one's own, written from the docstring of `jg.Actuator`: one that follows at
a limited rate, whose memory is its last command; and `jg.ControlLimits`."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIncompatibleVariableOverride=false

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator

import jaxguide as jg

STEP, RATE = 0.125, 2.0  # a sample is a power of two, so that sample times are exact


class Drift(jg.Problem):
    """x' = u, |u| <= 1."""

    state_names = ("x",)
    control_names = ("u",)
    control_bounds = (-1.0, 1.0)

    def dynamics(self, t, x, u):
        return u


class Towards(jg.Command):
    """From `u` at `t_k` towards `target` at `rate`, and no further."""

    u: jax.Array
    target: jax.Array
    t_k: Any
    rate: Any
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        most = self.rate * (t - self.t_k)
        return self.u + jnp.clip(self.target - self.u, -most, most)

    def deviation(self, t):
        return jnp.zeros_like(self.u)


class RateLimit(jg.Actuator):
    rate: Any

    def start(self, plant):
        return Towards(
            u=jnp.zeros(plant.m),
            target=jnp.zeros(plant.m),
            t_k=jnp.zeros(()),
            rate=jnp.asarray(self.rate),
            result=jg.RESULTS.where(True, jg.RESULTS.successful, jg.RESULTS.diverged),
            saturated=jnp.array(False),
        )

    def __call__(self, command, t_k, memory):
        flown = Towards(
            u=memory(t_k),
            target=command(t_k),
            t_k=t_k,
            rate=self.rate,
            result=command.result,
            saturated=command.saturated,
        )
        return flown, flown


class Step(jg.Law):
    """The control `size` from the first sample on."""

    size: Any

    def start(self, x0):
        return None

    def __call__(self, t_k, x, memory):
        u = jnp.full_like(x, self.size)
        return Towards(u, u, t_k, 0.0, jg.RESULTS.successful, jnp.array(False)), None


def reached(size, t):
    """The integral of min(RATE t, size)."""
    full = size / RATE
    return np.where(t < full, RATE * t**2 / 2, size * full / 2 + size * (t - full))


def test_a_step_at_a_limited_rate():
    """0.75 is reached after 0.375, at a sample: each sample's control is a line, flown exactly."""
    mission = jg.Mission(Drift(), Step(0.75), (0.0,), STEP, actuator=RateLimit(RATE))
    flight = jax.jit(jg.simulate)(mission)
    t = STEP * np.arange(9)
    np.testing.assert_allclose(flight.u[:, 0], np.minimum(RATE * t[:-1], 0.75), rtol=1e-14)
    np.testing.assert_allclose(flight.x[:, 0], reached(0.75, t), rtol=0, atol=1e-14)


def test_rollouts_and_derivative():
    mission = jg.Mission(Drift(), Step(0.75), (0.0,), STEP, actuator=RateLimit(RATE))
    keys = jax.random.split(jax.random.key(0), 6)
    spread = {"initial_state": jg.Normal(1.0)}
    flights = jax.jit(lambda keys: jg.rollouts(mission, spread, keys, "samples"))(keys)
    moved = flights.x[:, -1, 0] - flights.x[:, 0, 0]
    np.testing.assert_allclose(moved, np.full(6, reached(0.75, 1.0)), rtol=0, atol=1e-14)

    def end(rate):
        loop = dataclasses.replace(mission, law=Step(0.3), actuator=RateLimit(rate))
        return jg.simulate(loop, save="ends").final_state[0]

    # At once, but for the first stage of the first sample: a twelfth of it, with two steps of RK4.
    assert float(jax.jit(end)(1e9)) == pytest.approx(0.3 * (1 - STEP / 12), abs=1e-12)
    slow = jax.jit(jax.grad(end))(0.25)
    np.testing.assert_allclose(slow, 0.5, rtol=1e-12)  # x_f = rate/2, never reached


# The library's own -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def law(double_integrator):
    return jg.NeighboringOptimal(jg.gain_schedule(double_integrator, np.arange(8) / 8))


def by_hand(start, bound):
    """x'' = clip(6 - 12 t + du), by a thousand small steps a sample, each exact."""
    x, saturated, n = np.array(start, float), 0, 1000
    for k in range(8):
        T, h = 1 - k * STEP, STEP / n
        t = k * STEP
        dx = x - [3 * t**2 - 2 * t**3, 6 * t - 6 * t**2]
        du = -6 / T**2 * dx[0] - 4 / T * dx[1]
        saturated += abs(6 - 12 * t + du) > bound
        for i in range(n):
            u = np.clip(6 - 12 * (t + (i + 0.5) * h) + du, -bound, bound)
            x = np.array([x[0] + h * x[1] + u * h**2 / 2, x[1] + u * h])
    return x, saturated


def limited(law, bound, **options):
    plant = DoubleIntegrator(control_bounds=(-bound, bound))
    return jg.Mission(plant, law, (0.1, -0.1), STEP, actuator=jg.ControlLimits(), **options)


def test_control_limits(law):
    flight = jax.jit(jg.simulate)(limited(law, 4.0, integrator=jg.RungeKutta4(64)))
    want, saturated = by_hand((0.1, -0.1), 4.0)
    # Two kinks, each off by at most 12/8 of the step squared; and one step in 64,000 by hand.
    np.testing.assert_allclose(flight.final_state, want, rtol=0, atol=2e-5)
    assert float(flight.saturated) == saturated > 0
    assert np.abs(flight.u).max() == 4.0  # exactly
    # Bounds that nothing reaches change nothing.
    free = limited(law, 100.0)
    plain = dataclasses.replace(free, actuator=None)
    np.testing.assert_allclose(
        jax.jit(jg.simulate)(free).x, jax.jit(jg.simulate)(plain).x, rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("hold", [jg.HoldDeviation(), jg.History(), jg.HoldControl()])
def test_limits_are_the_same_on_both_paths(law, hold):
    """A hold given as a function is flown by the plain contracts, the library's own at stages."""
    fast = jax.jit(jg.simulate)(limited(law, 4.0, hold=hold))
    plain = jg.simulate(limited(law, 4.0, hold=lambda command, t: hold(command, t, None)[0]))
    np.testing.assert_allclose(fast.x, plain.x, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(fast.saturated, plain.saturated)


def test_limits_are_those_of_the_dispersed_plant(law):
    mission = limited(law, 4.0)
    lower = {"plant.control_bounds.0": jg.Uniform(0.0, 2.0)}
    keys = jax.random.split(jax.random.key(0), 4)
    flights = jax.jit(lambda keys: jg.rollouts(mission, lower, keys, "samples"))(keys)
    lowest = np.asarray(flights.u).min(axis=(1, 2))
    assert np.all(lowest > -4) and len(set(lowest)) == 4


def test_refusals(law):
    with pytest.raises(ValueError, match="actuator is the class ControlLimits; give an instance"):
        jg.Mission(DoubleIntegrator(), law, (0.0, 0.0), STEP, actuator=jg.ControlLimits)
    with pytest.raises(ValueError, match=r"actuator takes \(u\), but is called as actuator\(c"):
        jg.Mission(DoubleIntegrator(), law, (0.0, 0.0), STEP, actuator=lambda u: u)
