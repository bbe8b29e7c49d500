"""A sensor and a disturbance of one's own, written from the docstrings of `jg.Sensor` and
`jg.Disturbance`: a bias that walks at random, and a gust (Gauss-Markov)."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportIncompatibleVariableOverride=false

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import slow

import jaxguide as jg

STEP, FLIGHTS = 0.1, 4096


class Blown(jg.Problem):
    """x' = `grip` u, and whatever blows."""

    grip: float = 0.0
    state_names = ("x",)
    control_names = ("u",)

    def dynamics(self, t, x, u):
        return self.grip * u


class Show(jg.Law):
    """Commands what it is shown, so that a flight tells it."""

    def start(self, x0):
        return None

    def __call__(self, t_k, x, memory):
        return Constant(x, jg.RESULTS.successful, jnp.array(False)), None


class Constant(jg.Command):
    u: jax.Array
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        return jnp.zeros_like(self.u)

    def deviation(self, t):
        return self.u


class WalkingBias(jg.Sensor):
    """The state and a bias, which begins with deviation `first` and gains `step` at each sample."""

    first: Any
    step: Any

    def start(self, key, x0):
        return self.first * jax.random.normal(key, x0.shape, x0.dtype)

    def __call__(self, key, t, x, memory):
        walked = memory + self.step * jax.random.normal(key, x.shape, x.dtype)
        return x + memory, walked


class Gust(jg.Disturbance):
    """A rate of deviation `sigma` and correlation exp(-t/tau), constant within a sample."""

    sigma: Any
    tau: Any = 0.25

    def start(self, key, x0):
        return self.sigma * jax.random.normal(key, x0.shape, x0.dtype)

    def __call__(self, key, t, x, memory):
        kept = jnp.exp(-STEP / self.tau)
        fresh = self.sigma * jnp.sqrt(1 - kept**2)
        return memory, kept * memory + fresh * jax.random.normal(key, x.shape, x.dtype)


def fly(mission, spread=None):
    keys = jax.random.split(jax.random.key(2), FLIGHTS)
    spread = {"initial_state": jg.Normal(0.0)} if spread is None else spread
    return jax.jit(lambda m, keys: jg.rollouts(m, spread, keys, "samples"))(mission, keys)


# The standard error of a variance from N normal numbers is sqrt(2/N) of it, that of a correlation
# at most sqrt(1/N). Five of them: one in two million, and the seed is fixed.
VARIANCE, CORRELATION = 5 * np.sqrt(2 / FLIGHTS), 5 * np.sqrt(1 / FLIGHTS)


def test_the_bias_walks():
    mission = jg.Mission(Blown(), Show(), (0.5,), STEP, sensor=WalkingBias(0.3, 0.2))
    flights = fly(mission)
    bias = np.asarray(flights.commands)[:, :, 0] - 0.5
    want = 0.3**2 + np.arange(10) * 0.2**2
    np.testing.assert_allclose(bias.var(axis=0), want, rtol=VARIANCE)
    steps = np.diff(bias, axis=1)
    assert abs(np.corrcoef(steps[:, 0], steps[:, 5])[0, 1]) < CORRELATION
    assert abs(np.corrcoef(bias[:, 0], steps[:, 0])[0, 1]) < CORRELATION
    np.testing.assert_array_equal(flights.x, np.full((FLIGHTS, 11, 1), 0.5))


def test_the_gust_is_stationary():
    mission = jg.Mission(Blown(), Show(), (0.0,), STEP, disturbance=Gust(0.6))
    x = np.asarray(fly(mission).x)[:, :, 0]
    gust = np.diff(x, axis=1) / STEP  # the rate of each sample
    np.testing.assert_allclose(gust.var(axis=0), 0.6**2, rtol=VARIANCE)
    for lag in (1, 3):
        got = np.corrcoef(gust[:, 2], gust[:, 2 + lag])[0, 1]
        assert abs(got - np.exp(-lag * STEP / 0.25)) < CORRELATION


def test_sensor_and_gust_are_independent():
    mission = jg.Mission(
        Blown(), Show(), (0.0,), STEP, sensor=WalkingBias(0.3, 0.2), disturbance=Gust(0.6)
    )
    flights = fly(mission)
    x = np.asarray(flights.x)[:, :, 0]
    bias = np.asarray(flights.commands)[:, :, 0] - x[:, :-1]
    gust = np.diff(x, axis=1) / STEP
    for a in (bias[:, 0], np.diff(bias)[:, 4]):
        for b in (gust[:, 0], gust[:, 4], gust[:, 5]):
            assert abs(np.corrcoef(a, b)[0, 1]) < CORRELATION


@pytest.mark.parametrize(
    "integrator",
    [jg.RungeKutta4(), slow(jg.Adaptive())],
    ids=["fixed", "adaptive"],
)
def test_derivative_by_the_strength(integrator):
    """All that moves the vehicle is proportional to sigma."""
    mission = jg.Mission(
        Blown(), Show(), (0.0,), STEP, disturbance=Gust(jnp.asarray(0.6)), integrator=integrator
    )

    def end(sigma):
        loop = dataclasses.replace(mission, disturbance=Gust(sigma))
        return jg.simulate(loop, jax.random.key(3)).final_state[0]

    value, slope = jax.jit(jax.value_and_grad(end))(0.6)
    np.testing.assert_allclose(slope, value / 0.6, rtol=1e-10)
    assert abs(float(value)) > 1e-3


def test_strength_and_bias_can_be_dispersed():
    mission = jg.Mission(
        Blown(), Show(), (0.0,), STEP, sensor=WalkingBias(0.3, 0.0), disturbance=Gust(0.0)
    )
    flights = fly(mission, {"disturbance.sigma": jg.Normal(0.5)})
    gust = np.diff(np.asarray(flights.x)[:, :, 0], axis=1)[:, 0] / STEP
    # A product of two normal numbers: variance of one times that of the other, kurtosis 9.
    np.testing.assert_allclose(gust.var(), 0.5**2, rtol=5 * np.sqrt(8 / FLIGHTS))


def test_functions_without_memory():
    """A constant push of 0.5, and a sensor that is off by 0.1, on x' = u + 0.5, u = y."""
    mission = jg.Mission(
        Blown(1.0),
        Show(),
        (0.0,),
        STEP,
        sensor=lambda key, t, x: x + 0.1,
        disturbance=lambda t, x: jnp.full_like(x, 0.5),
    )
    x = np.asarray(jg.simulate(mission, jax.random.key(0)).x)[:, 0]
    np.testing.assert_allclose(x, 0.6 * ((1 + STEP) ** np.arange(11) - 1), rtol=1e-12)


def test_refusals():
    make = lambda **options: jg.Mission(Blown(), Show(), (0.0,), STEP, **options)
    for options in ({"sensor": WalkingBias(0.1, 0.1)}, {"disturbance": Gust(0.1)}):
        with pytest.raises(
            ValueError, match=f"has a {next(iter(options))}, which needs a PRNG key"
        ):
            jg.simulate(make(**options))
    with pytest.raises(ValueError, match=r"sensor takes \(t, x\), but is called as sensor\(key, t"):
        make(sensor=lambda t, x: x)
    with pytest.raises(ValueError, match=r"disturbance takes \(t, x, u\).*disturbance\(t, x\)"):
        make(disturbance=lambda t, x, u: x)
    with pytest.raises(ValueError, match="disturbance is the class Gust; give an instance"):
        make(disturbance=Gust)
