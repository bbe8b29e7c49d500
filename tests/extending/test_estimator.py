"""An estimator of one's own, written from the docstring of `jg.Estimator`: a Kalman filter, against
least squares over all measurements at once."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIncompatibleVariableOverride=false

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxguide as jg

STEP, R, P0, GUESS, START, K = 0.1, 0.04, 0.5, 0.2, 1.0, 3.0


class Drift(jg.Problem):
    """x' = u, |u| <= 1."""

    state_names = ("x",)
    control_names = ("u",)
    control_bounds = (-1.0, 1.0)

    def dynamics(self, t, x, u):
        return u


class Follow(jg.Command):
    """-K of the estimate, fading linearly over the sample: not constant, for the filter to see."""

    u: jax.Array
    t_k: Any
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        return jnp.zeros_like(self.u)

    def deviation(self, t):
        return self.u * (1 - (t - self.t_k))


class Proportional(jg.Law):
    K: Any

    def start(self, x0):
        return None

    def __call__(self, t_k, x, memory):
        return Follow(-self.K * x, t_k, jg.RESULTS.successful, jnp.array(False)), None


class Kalman(jg.Estimator):
    """Of x' = u, y = x + noise of variance `R`; the state is not disturbed."""

    R: Any
    P0: Any
    guess: Any

    def start(self, x0):
        return jnp.full_like(x0, self.guess), self.P0 * jnp.eye(1)

    def predict(self, memory, flown, t, t_next):
        x, P = memory
        middle = (t + t_next) / 2  # Simpson's rule is exact for a control linear in time
        mean = (flown(t) + 4 * flown(middle) + flown(t_next)) / 6
        return x + mean * (t_next - t), P

    def update(self, memory, t, y):
        x, P = memory
        gain = P / (P + self.R)
        x, P = x + gain @ (y - x), (jnp.eye(1) - gain) @ P
        return jg.Estimate(x, P), (x, P)


def wavering(key, t, x):
    return x + 0.3 * jnp.cos(40 * t)


def loop(hold=None, **options):
    return jg.Mission(
        Drift(),
        Proportional(jnp.asarray(K)),
        jnp.array([START]),
        STEP,
        hold=jg.History() if hold is None else hold,
        sensor=wavering,
        estimator=Kalman(jnp.asarray(R), jnp.asarray(P0), jnp.asarray(GUESS)),
        **options,
    )


def estimates(x, R=R):
    """By least squares: the initial state from its guess and from every measurement up to each
    sample, taken back by the path flown between, which nothing disturbs."""
    x = np.asarray(x)
    t = STEP * np.arange(10)
    back = x[:10] + 0.3 * np.cos(40 * t) - (x[:10] - x[0])
    weights = 1 / P0 + np.arange(1, 11) / R
    return (GUESS / P0 + np.cumsum(back) / R) / weights + (x[:10] - x[0])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"hold": jg.HoldDeviation()},
        {"hold": jg.HoldDeviation(), "actuator": jg.ControlLimits()},
    ],
    ids=["history", "held", "limited"],
)
def test_filter_against_least_squares(options):
    """The filter is given the control that was flown, whatever hold and actuator made of it."""
    flight = eqx.filter_jit(jg.simulate)(loop(**options), jax.random.key(0))
    want = -K * estimates(flight.x[:, 0])
    if "actuator" in options:
        assert 0 < float(flight.saturated) == np.sum(np.abs(want) > 1) < 10
        want = np.clip(want, -1, 1)
    # Each control is a line in time, which Simpson's rule and RK4 take exactly: rounding only.
    np.testing.assert_allclose(flight.u[:, 0], want, rtol=0, atol=1e-12)


def test_rollouts_and_derivative():
    mission = loop()
    spread = {"initial_state": jg.Normal(0.2), "estimator.R": jg.Uniform(-0.01, 0.01)}
    keys = jax.random.split(jax.random.key(1), 4)
    flights = eqx.filter_jit(lambda keys: jg.rollouts(mission, spread, keys, "samples"))(keys)
    for x, u in zip(flights.x[:, :, 0], flights.u[:, :, 0], strict=True):
        first = float(u[0]) / -K  # which shows this flight's R
        y = float(x[0]) + 0.3
        gain = (first - GUESS) / (y - GUESS)
        np.testing.assert_allclose(u, -K * estimates(x, P0 / gain - P0), rtol=0, atol=1e-11)

    def first_command(R):
        estimator = Kalman(R, jnp.asarray(P0), jnp.asarray(GUESS))
        mission = jg.Mission(
            Drift(), Proportional(K), (START,), STEP, sensor=wavering, estimator=estimator
        )
        return jg.simulate(mission, jax.random.key(0)).commands[0, 0]

    slope = jax.jit(jax.grad(first_command))(R)
    # u = -K (guess + P0/(P0 + R) (y - guess))
    np.testing.assert_allclose(slope, K * P0 / (P0 + R) ** 2 * (START + 0.3 - GUESS), rtol=1e-12)


def test_a_function_as_estimator():
    mission = loop()
    options = {"sensor": wavering, "estimator": lambda t, y: y - 0.3 * jnp.cos(40 * t)}
    plain = jg.Mission(mission.plant, mission.law, (START,), STEP, **options)
    flight = eqx.filter_jit(jg.simulate)(plain, jax.random.key(0))
    np.testing.assert_allclose(flight.u[:, 0], -K * flight.x[:-1, 0], rtol=0, atol=1e-12)


class Old:
    def start(self, x0):
        return x0

    def __call__(self, t, y, memory):
        return y, memory


def test_refusals():
    make = lambda estimator: jg.Mission(
        Drift(), Proportional(K), (START,), STEP, estimator=estimator
    )
    with pytest.raises(ValueError, match=r"jg.Estimator: `update\(memory, t, y\).*`predict\(mem"):
        make(Old())
    with pytest.raises(ValueError, match=r"takes \(y\), but is called as estimator\(t, y\)"):
        make(lambda y: y)
    with pytest.raises(ValueError, match="estimator is the class Kalman; give an instance"):
        make(Kalman)
