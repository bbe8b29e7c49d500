"""An integrator of one's own, written from the docstring of `jg.Integrator`: Heun's method."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxguide as jg

STEP = 0.25


class Heun(jg.Integrator):
    """Of second order; gives up where the state grows beyond `most`."""

    steps: int = eqx.field(static=True, default=4)
    most: float = eqx.field(static=True, default=1e6)

    def across(self, rate, flown, t, t_next, x):
        h = (t_next - t) / self.steps

        def step(x, i):
            s = t + i * h
            k = rate(s, x, flown(s))
            return x + h / 2 * (k + rate(s + h, x + h * k, flown(s + h))), None

        x, _ = jax.lax.scan(step, x, jnp.arange(self.steps).astype(x.dtype))
        fine = jnp.all(jnp.abs(x) < self.most)
        RESULTS = jg.RESULTS
        return x, RESULTS.where(fine, RESULTS.successful, RESULTS.undefined)


class Decay(jg.Problem):
    """x' = -x + u."""

    state_names = ("x",)
    control_names = ("u",)
    final_time = 2.0

    def dynamics(self, t, x, u):
        return -x + u


class Wave(jg.Command):
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        return jnp.sin(t)[None]

    def deviation(self, t):
        return jnp.zeros(1)


class Waving(jg.Law):
    def start(self, x0):
        return None

    def __call__(self, t_k, x, memory):
        return Wave(jg.RESULTS.successful, jnp.array(False)), None


def mission(integrator, start=0.7):
    start = jnp.atleast_1d(jnp.asarray(start))
    return jg.Mission(Decay(), Waving(), start, STEP, hold=jg.History(), integrator=integrator)


def exact(start):
    """x' = -x + sin t: (sin t - cos t)/2 and what is left of the start."""
    t = STEP * np.arange(9)
    return (np.sin(t) - np.cos(t)) / 2 + (start + 0.5) * np.exp(-t)


def test_order():
    fly = lambda steps: np.asarray(jax.jit(jg.simulate)(mission(Heun(steps))).x)[:, 0]
    errors = [np.abs(fly(steps) - exact(0.7)).max() for steps in (2, 4, 8)]
    # Halving the step divides the error by 2^2, up to the next order.
    for coarse, fine in zip(errors[:-1], errors[1:], strict=True):
        assert 3.6 < coarse / fine < 4.6, errors
    assert 1e-5 < errors[-1] < 1e-3


def test_the_library_s_own_agree():
    for integrator, error in ((jg.RungeKutta4(8), 1e-8), (jg.Adaptive(1e-12), 1e-11)):
        flight = jax.jit(jg.simulate)(mission(integrator))
        np.testing.assert_allclose(flight.x[:, 0], exact(0.7), rtol=0, atol=error)


def test_rollouts_and_derivative():
    loop, keys = mission(Heun()), jax.random.split(jax.random.key(0), 5)
    spread = {"initial_state": jg.Normal(1.0)}
    flights = jax.jit(lambda keys: jg.rollouts(loop, spread, keys, "samples"))(keys)
    h = STEP / 4
    growth = (1 - h + h**2 / 2) ** 32  # of Heun's method on x' = -x over all its steps
    ends, starts = np.asarray(flights.x)[:, -1, 0], np.asarray(flights.x)[:, 0, 0]
    np.testing.assert_allclose(np.diff(ends), growth * np.diff(starts), rtol=1e-11)
    end = lambda start: jg.simulate(mission(Heun(), start), save="ends").final_state[0]
    np.testing.assert_allclose(jax.jit(jax.grad(end))(0.7), growth, rtol=1e-12)


def test_spare_samples_are_flown_in_no_time():
    short = jax.jit(jg.simulate)(mission(Heun()))
    spare = jg.Mission(
        Decay(), Waving(), (0.7,), STEP, hold=jg.History(), integrator=Heun(), max_samples=11
    )
    np.testing.assert_array_equal(jax.jit(jg.simulate)(spare).final_state, short.final_state)


def test_an_integrator_that_gives_up():
    flight = jax.jit(jg.simulate)(mission(Heun(most=0.5)))
    assert bool(flight.result == jg.RESULTS.diverged)
    kept = np.asarray(flight.x)[:, 0]  # held at the last state that was found
    assert np.all(kept == 0.7)


def test_refusals():
    with pytest.raises(ValueError, match="integrator is the class Heun; give an instance: Heun()"):
        mission(Heun)
    with pytest.raises(ValueError, match="integrator is .* derived from jg.Integrator"):
        mission(lambda t: t)
