"""A law of one's own, written from the docstring of `jg.Law`: proportional-integral control, whose
memory is the integral, and a law that decides when its flight ends."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIncompatibleVariableOverride=false

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxguide as jg


class Constant(jg.Command):
    """The control `u` until the next sample."""

    u: jax.Array
    result: jg.RESULTS
    saturated: jax.Array
    left: Any = None

    def nominal(self, t):
        return jnp.zeros_like(self.u)

    def deviation(self, t):
        return self.u

    @property
    def time_to_go(self):
        return self.left


class ProportionalIntegral(jg.Law):
    """u = -P x - I z, where z adds up x times the interval."""

    P: Any
    I: Any
    interval: Any

    def start(self, x0):
        return jnp.zeros_like(x0)

    def __call__(self, t_k, x, memory):
        z = memory + x * self.interval
        u = -self.P * x - self.I * z
        return Constant(u, jg.RESULTS.successful, jnp.array(False)), z


class Pushed(jg.Problem):
    """x' = u + push."""

    push: float = 0.0
    state_names = ("x",)
    control_names = ("u",)
    final_time = 6.0

    def dynamics(self, t, x, u):
        return u + self.push


STEP, P, I = 0.1, 2.0, 1.5
LOOP = np.array([[1 - STEP * P - STEP**2 * I, -STEP * I], [STEP, 1.0]])  # of (x, z), exactly
PUSH = np.array([STEP, 0.0])


@pytest.fixture(scope="module")
def mission():
    return jg.Mission(Pushed(0.7), ProportionalIntegral(P, I, STEP), (0.4,), STEP)


def by_hand(x0, push, samples=60):
    states = [np.array([x0, 0.0])]
    for _ in range(samples):
        states.append(LOOP @ states[-1] + PUSH * push)
    return np.array(states)


def test_integral_action_takes_a_constant_push_away(mission):
    flight = jax.jit(jg.simulate)(mission)
    # The plant integrates a constant, which is exact: rounding only.
    np.testing.assert_allclose(flight.x[:, 0], by_hand(0.4, 0.7)[:, 0], rtol=0, atol=1e-13)
    # What is left after 6 units of time: the slowest eigenvalue of the loop to the 60th power.
    left = np.abs(np.linalg.eigvals(LOOP)).max() ** 60
    assert abs(float(flight.final_state[0])) < 2 * left < 0.02
    np.testing.assert_allclose(flight.u[-1], -0.7, rtol=0, atol=2 * left)
    assert bool(flight.result == jg.RESULTS.successful)


def test_rollouts_of_it(mission):
    keys = jax.random.split(jax.random.key(0), 8)
    spread = {"initial_state": jg.Uniform(-0.1, 0.1), "plant.push": jg.Normal(0.2)}
    flights = jax.jit(lambda keys: jg.rollouts(mission, spread, keys, "samples"))(keys)
    for x, u in zip(flights.x, flights.u, strict=True):
        # The push as the first interval shows it.
        push = (x[1, 0] - x[0, 0]) / STEP - u[0, 0]
        want = by_hand(float(x[0, 0]), float(push))
        np.testing.assert_allclose(x[:, 0], want[:, 0], rtol=0, atol=1e-11)
    assert np.std(flights.x[:, 0, 0]) > 0.02


def test_derivatives_by_the_push_and_by_the_gain(mission):
    def end(push, gain):
        law = dataclasses.replace(mission.law, I=gain)
        loop = dataclasses.replace(mission, plant=Pushed(push), law=law)
        return jg.simulate(loop, save="ends").final_state[0]

    by_push, by_gain = jax.jit(jax.grad(end, (0, 1)))(jnp.asarray(0.7), jnp.asarray(I))
    powers = [np.linalg.matrix_power(LOOP, k) for k in range(60)]
    np.testing.assert_allclose(by_push, sum(M[0] @ PUSH for M in powers), rtol=1e-12)
    # d(LOOP)/dI puts -(h^2 x + h z) into x at each sample; the loop takes it to the end.
    states = by_hand(0.4, 0.7)
    moved = sum(
        powers[59 - k][0, 0] * -(STEP**2 * x + STEP * z) for k, (x, z) in enumerate(states[:-1])
    )
    np.testing.assert_allclose(by_gain, moved, rtol=1e-11)


class Arrive(jg.Law):
    """Flies at a given speed and ends the flight at x = 1."""

    decides_end = True

    speed: Any

    def start(self, x0):
        return None

    def __call__(self, t_k, x, memory):
        left = (1 - x[0]) / self.speed
        u = jnp.full_like(x, self.speed)
        return Constant(u, jg.RESULTS.successful, jnp.array(False), left), None

    def latest_end(self, initial_time):
        return initial_time + 2 / self.speed


class Endless(Arrive):
    def latest_end(self, initial_time):
        return None


def test_a_law_that_decides_the_end():
    def end(speed):
        flight = jg.simulate(jg.Mission(Pushed(), Arrive(speed), (0.0,), 0.3, max_samples=20))
        return flight.final_time, flight.final_state

    time, state = jax.jit(end)(0.8)
    # The end comes after 1/0.8, which is no multiple of the interval.
    np.testing.assert_allclose(time, 1 / 0.8, rtol=1e-12)
    np.testing.assert_allclose(state, [1.0], rtol=1e-12)
    slope = jax.grad(lambda speed: end(speed)[0])(0.8)
    np.testing.assert_allclose(slope, -1 / 0.8**2, rtol=1e-12)


def test_refusals():
    with pytest.raises(ValueError, match="Endless decides the end.*no latest_end; pass final_time"):
        jg.Mission(Pushed(), Endless(1.0), (0.0,), 0.3)
    with pytest.raises(ValueError, match="law is the class Arrive; give an instance"):
        jg.Mission(Pushed(), Arrive, (0.0,), 0.3)
    with pytest.raises(ValueError, match="law is .*; give an instance of a class derived.*jg.Law"):
        jg.Mission(Pushed(), lambda t, x: -x, (0.0,), 0.3)

    class Silent(Arrive):
        def __call__(self, t_k, x, memory):
            return Constant(x, jg.RESULTS.successful, jnp.array(False)), None

    with pytest.raises(ValueError, match="time_to_go of its Constant is None"):
        jg.simulate(jg.Mission(Pushed(), Silent(1.0), (0.0,), 0.3))
