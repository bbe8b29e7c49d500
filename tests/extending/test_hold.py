"""A hold of one's own, written from the docstring of `jg.Hold`: a first-order hold, whose memory is
the sample before, and holds that ask the command for other times than the sample's."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator

import jaxguide as jg

STEP, START = 0.1, (0.1, -0.1)


class Line(jg.Command):
    """The nominal of `command`, and a deviation that changes at a constant rate."""

    command: Any
    t_k: jax.Array
    du: jax.Array
    slope: jax.Array
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        return self.command.nominal(t)

    def deviation(self, t):
        return self.du + self.slope * (t - self.t_k)


class FirstOrder(jg.Hold):
    """The deviation goes on along the line through this sample and the last."""

    def start(self):
        # No line through one sample: none has been seen at the time of -inf.
        return jnp.asarray(-jnp.inf), jnp.zeros(1)

    def __call__(self, command, t_k, memory):
        before, last = memory
        du = command.deviation(t_k)
        slope = jnp.where(jnp.isfinite(before), (du - last) / (t_k - before), 0.0)
        line = Line(command, t_k, du, slope, command.result, command.saturated)
        return line, (jnp.asarray(t_k), du)


def at_middle(command, t_k):
    """Holds the command's whole control at the middle of the sample."""
    middle = t_k + STEP / 2
    u = command(middle)
    zero = jnp.zeros_like(u)
    fixed = Fixed(u, command.result, command.saturated)
    return Line(fixed, t_k, zero, zero, command.result, command.saturated)


class Fixed(jg.Command):
    u: jax.Array
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        return self.u

    def deviation(self, t):
        return jnp.zeros_like(self.u)


class Later(jg.HoldDeviation):
    """The deviation as the law would have it three quarters of a sample later."""

    def __call__(self, command, t_k, memory):
        du = command.deviation(t_k + 0.75 * STEP)
        return Line(command, t_k, du, 0 * du, command.result, command.saturated), None


@pytest.fixture(scope="module")
def law(double_integrator):
    return jg.NeighboringOptimal(jg.gain_schedule(double_integrator, np.arange(10) / 10))


def by_hand(start, hold):
    """The loop about u* = 6 - 12 t on x'' = u, where du = K(t; t_k) dx is a line in t."""
    dx, path, before = np.array(start, float), [], None
    for k in range(10):
        T, h = 1 - k * STEP, STEP
        du, rate = -6 / T**2 * dx[0] - 4 / T * dx[1], 12 / T**3 * dx[0] + 6 / T**2 * dx[1]
        if hold == "first order":
            a, slope = du, 0.0 if before is None else (du - before) / h
        elif hold == "later":
            a, slope = du + 0.75 * h * rate, 0.0
        else:  # at the middle, of nominal and deviation; the nominal falls by 12 a unit of time
            a, slope = du + 0.5 * h * rate - 6 * h, 12.0
        before = du
        path.append(a)
        dx = np.array(
            [dx[0] + h * dx[1] + a * h**2 / 2 + slope * h**3 / 6, dx[1] + a * h + slope * h**2 / 2]
        )
    return np.array([1.0, 0.0]) + dx


HOLDS = {"first order": FirstOrder(), "middle": at_middle, "later": Later()}


@pytest.mark.parametrize("name", HOLDS)
@pytest.mark.parametrize("integrator", [jg.RungeKutta4(), jg.Adaptive()], ids=["fixed", "adaptive"])
def test_flights_against_a_loop_by_hand(law, name, integrator):
    """The law could be looked up at the integrator's stages, but no such hold keeps to them."""
    loop = jg.Mission(DoubleIntegrator(), law, START, STEP, hold=HOLDS[name], integrator=integrator)
    flight = jax.jit(jg.simulate)(loop) if name != "middle" else jg.simulate(loop)
    # Cubics in time, which both fly exactly; gains are good to 1e-9.
    np.testing.assert_allclose(flight.final_state, by_hand(START, name), rtol=0, atol=1e-8)
    assert bool(flight.result == jg.RESULTS.successful)


def test_rollouts_and_derivative(law):
    loop = jg.Mission(DoubleIntegrator(), law, START, STEP, hold=FirstOrder())
    spread, keys = {"initial_state": jg.Normal(0.1)}, jax.random.split(jax.random.key(0), 5)
    flights = jax.jit(lambda keys: jg.rollouts(loop, spread, keys, "samples"))(keys)
    for x in np.asarray(flights.x):
        np.testing.assert_allclose(x[-1], by_hand(x[0], "first order"), rtol=0, atol=1e-8)

    def end(start):
        return jg.simulate(
            jg.Mission(DoubleIntegrator(), law, start, STEP, hold=FirstOrder()), save="ends"
        ).final_state

    slope = jax.jit(jax.jacrev(end))(jnp.array(START))
    base = by_hand((0.0, 0.0), "first order")  # the loop is linear in its start
    want = np.stack([by_hand(e, "first order") - base for e in np.eye(2)], axis=1)
    np.testing.assert_allclose(slope, want, rtol=0, atol=1e-7)


def test_as_the_hold_of_the_last_sample(law):
    """Its memory goes along from the first sample on."""
    loop = jg.Mission(DoubleIntegrator(), law, START, STEP, last=FirstOrder())
    flight = jax.jit(jg.simulate)(loop)
    du, x = np.asarray(flight.commands)[:, 0], np.asarray(flight.x)
    slope = (du[-1] - du[-2]) / STEP - 12
    a = 6 - 12 * 0.9 + du[-1]
    end = x[-2] + [STEP * x[-2, 1] + a * STEP**2 / 2 + slope * STEP**3 / 6, a * STEP]
    np.testing.assert_allclose(flight.final_state[0], end[0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(
        flight.final_state[1], end[1] + slope * STEP**2 / 2, rtol=0, atol=1e-8
    )


def test_refusals(law):
    make = lambda **options: jg.Mission(DoubleIntegrator(), law, START, STEP, **options)
    with pytest.raises(ValueError, match=r"hold takes \(command\), but is called as hold\(c"):
        make(hold=lambda command: command)
    with pytest.raises(ValueError, match="last is the class History; give an instance: History()"):
        make(last=jg.History)
    with pytest.raises(ValueError, match="hold is 3; give an instance of a class derived from"):
        make(hold=3)
