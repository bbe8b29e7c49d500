"""Many problems at once: lanes equal single solves, failures stay in their lane, nothing hangs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator, once

import jaxguide as jg

METHOD = jg.Pseudospectral(nodes=4, segments=2, refinements=0)


def pushed(k):
    """The double integrator with its control scaled by k: J = 6/k^2."""
    return dataclasses.replace(DoubleIntegrator(), k=k)


class Meter:
    """Keeps what it was shown."""

    def init(self):
        return []

    def step(self, state, progress):
        self.shown = [*state, progress]
        return self.shown

    def close(self, state):
        self.closed = True


@pytest.mark.parametrize("count", [64, 256])
@pytest.mark.slow
def test_lanes_are_single_solves(count):
    k = jnp.linspace(0.5, 2.0, count)
    meter = Meter()
    e = jg.solve_batch(jax.vmap(pushed)(k), METHOD, progress=meter)
    np.testing.assert_allclose(e.objective, 6 / k**2, rtol=1e-10)
    assert np.all(np.asarray(e.result == jg.RESULTS.successful))
    assert meter.shown[-1] == 1.0 and meter.closed
    one = jg.solve(pushed(k[3]), METHOD)
    # A single solve is NumPy's, a lane XLA's: the same steps, rounded in another order.
    np.testing.assert_allclose(e.x[3], one.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(e.costate[3], one.costate, rtol=0, atol=1e-11)  # sizes up to 48


@pytest.mark.parametrize("count", [64, 256])
@pytest.mark.slow
def test_vmap_under_jit_ends(count):
    # sequential_vmap: batched LAPACK has deadlocked at 64.
    k = jnp.linspace(0.5, 2.0, count)
    objective = lambda k: jg.solve(pushed(k), METHOD, throw=False).objective
    np.testing.assert_allclose(once(jax.vmap(objective))(k), 6 / k**2, rtol=1e-10)


@pytest.mark.slow
def test_a_failed_lane_disturbs_no_other():
    class Reach(DoubleIntegrator):
        asked: object = 1.0
        control_bounds = (-10.0, 10.0)

        def endpoint_constraints(self, x0, xf, t0, tf):
            return xf - jnp.stack([jnp.asarray(self.asked), 0.0])

    # |u| <= 10 reaches 2.5 in one unit of time, at most.
    lanes = [dataclasses.replace(Reach(), asked=a) for a in (1.0, 4.0, 1.5)]
    e = jg.solve_batch(lanes, METHOD)
    np.testing.assert_array_equal(e.result == jg.RESULTS.successful, [True, False, True])
    np.testing.assert_allclose(e.x[:, -1, 0][jnp.array([0, 2])], [1.0, 1.5], atol=1e-8)
    with pytest.raises(jg.SolveError, match="1 of 3 lanes failed: 1"):
        jg.solve_batch(lanes, METHOD, throw=True)


def test_lanes_that_do_not_stack():
    with pytest.raises(ValueError, match="leading axes"):
        jg.solve_batch(DoubleIntegrator(), METHOD)
    with pytest.raises(ValueError, match="no problems"):
        jg.solve_batch([], METHOD)
    with pytest.raises(ValueError, match="problem 1 differs"):
        jg.solve_batch([DoubleIntegrator(), pushed(jg.Free(0.5, 2.0))], METHOD)
