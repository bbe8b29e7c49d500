"""Refinement that keeps what it found: kinks, touching points, breaks, records, and ends at which
constraints meet."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator, once

import jaxguide as jg


def failing(e):
    return [row["check"] for row in e.certificate.rows() if not row["passed"]]


class Kink(jg.Problem):
    """Van der Pol's oscillator; the control leaves one bound and rides on the other."""

    state_names = ("x1", "x2")
    control_names = ("u",)
    initial_state = (0.0, 1.0)
    final_time = 5.0
    control_bounds = (-0.3, 1.0)

    def dynamics(self, t, x, u):
        return jnp.stack([(1 - x[1] ** 2) * x[0] - x[1] + u[0], x[0]])

    def running_cost(self, t, x, u):
        return x[0] ** 2 + x[1] ** 2 + u[0] ** 2


class Capped(jg.Problem):
    """x'' = u, rest to rest over 1 in time 2, least int u^2/2, |u| <= 1.4. On bounds until 1 - h
    and from 1 + h, h = sqrt(6/7), linear between: J = 1.96 (1 - h) + 1.96 h/3."""

    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 0.0)
    final_time = 2.0
    control_bounds = (-1.4, 1.4)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0]])

    def running_cost(self, t, x, u):
        return 0.5 * u[0] ** 2

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf - jnp.array([1.0, 0.0])


# Of the oscillator: shooting on costates and three junctions, arc by arc, DOP853 to 3e-14.
@pytest.mark.parametrize(
    ("problem", "value"),
    [(Kink(), 2.8672610452216687), (Capped(), 1.96 * (1 - 2 / 3 * math.sqrt(6 / 7)))],
)
def test_a_control_meets_its_bound_with_a_kink(problem, value):
    steps = []
    e = jg.solve(problem, watch=lambda step: steps.append(step.step))
    np.testing.assert_allclose(e.objective, value, rtol=1e-12)
    assert not failing(e), str(e.certificate)
    assert steps.count("more segments") == 0, steps  # found on the first size of mesh


class Idle(jg.Problem):
    """Two states and a control that have nothing to do: without them the first mesh is right."""

    state_names = ("x", "v", "y", "w")
    control_names = ("a", "b")
    initial_state = (0.0, 0.0, 0.0, 0.0)
    final_time = 1.0
    control_bounds = (-10.0, 10.0)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0] - x[0] ** 3, x[3], u[1] - x[2]])

    def running_cost(self, t, x, u):
        return u @ u

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf - jnp.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("bound", [10.0, np.inf])
def test_states_at_rest_do_not_drive_the_mesh(bound):
    steps = []
    e = jg.solve(Idle(control_bounds=(-bound, bound)), jg.Pseudospectral(), watch=steps.append)
    np.testing.assert_allclose(e.objective, 9.947356846, rtol=1e-9)  # a mesh of 96 segments
    assert len(steps) <= 3, [str(s) for s in steps]
    assert not failing(e), str(e.certificate)


class Spring(jg.Problem):
    """A damped spring over a wall at -4; the farthest start from which it just touches the wall."""

    state_names = ("x", "v")
    initial_state = (jg.Free(), 0.0)
    final_time = 10.0
    state_bounds = ((-4.0, -math.inf), (math.inf, math.inf))

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], -x[0] - 0.5 * x[1]])

    def endpoint_cost(self, x0, xf, t0, tf):
        return -x0[0]


class Wall(Spring):
    """The same by a path constraint."""

    state_bounds = (-math.inf, math.inf)
    path_bounds = (-math.inf, 4.0)

    def path_constraints(self, t, x, u):
        return -x[:1]


@pytest.mark.parametrize("problem", [Spring(), Wall()])
def test_bounds_hold_between_nodes(problem):
    far = -4.0 * math.exp(math.pi * 0.25 / math.sqrt(1 - 0.0625))  # decrement of half a period
    e = jg.solve(problem)
    # The optimiser's bounds have 1e-9 of room, which the decrement multiplies by 2.25.
    np.testing.assert_allclose(e.objective, far, rtol=2.5e-9)
    if not isinstance(problem, Wall):  # an impulse of a path constraint is not certified
        assert not failing(e), str(e.certificate)
    low = jax.vmap(lambda t: e(t).x[0])(jnp.linspace(0.0, 10.0, 4001)).min()
    assert low >= -4 - 1e-8
    coarse = jg.solve(problem, jg.Pseudospectral(refinements=0))
    row = "path constraints" if isinstance(problem, Wall) else "state bounds"
    assert row in failing(coarse), "overstepped by 9e-5 between nodes"


TIMES = np.linspace(0.0, 6.0, 61)
_w = math.sqrt(4.0 - 0.15**2)
RECORD = np.exp(-0.15 * TIMES) * (np.cos(_w * TIMES) + 0.15 / _w * np.sin(_w * TIMES))
RECORD = RECORD + 0.05 * np.random.default_rng(1).normal(size=61)


class Identify(jg.Problem):
    """Stiffness, damping and start of an oscillator from a record interpolated linearly: nothing to
    control. J by least squares of the same integral with SciPy."""

    k: Any = jg.Free(0.1, 50.0)
    c: Any = jg.Free(0.0, 5.0)
    state_names = ("x", "v")
    initial_state = jg.Free()
    final_time = 6.0

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], -self.k * x[0] - self.c * x[1]])

    def running_cost(self, t, x, u):
        return (x[0] - jnp.interp(t, TIMES, RECORD)) ** 2


LEAST = 0.00728981800716972


def test_kinks_of_a_record_become_breaks():
    e = jg.solve(Identify())
    np.testing.assert_allclose(e.objective, LEAST, rtol=1e-8)
    nearest = np.abs(np.asarray(e.breaks)[:, None] - TIMES[None]).min(axis=0)
    assert nearest.max() < 1e-6
    assert not failing(e), str(e.certificate)
    assert e.u.shape == (len(e.t), 0) and e(1.0).u.shape == (0,)


def test_given_breaks_are_kept():
    method = jg.Pseudospectral(nodes=4, fractions=tuple(TIMES / 6.0))
    e = jg.solve(Identify(), method)
    np.testing.assert_allclose(e.objective, LEAST, rtol=1e-8)
    nearest = np.abs(np.asarray(e.breaks)[:, None] - TIMES[None]).min(axis=0)
    assert nearest.max() < 1e-12
    with pytest.raises(ValueError, match="no control"):
        jg.solve(Identify(k=4.0, c=0.3), jg.Shooting())


@pytest.mark.slow
def test_nothing_to_control_under_a_trace():
    method = jg.Pseudospectral(nodes=4, fractions=tuple(TIMES / 6.0), refinements=0)

    class Weighted(Identify):
        weight: float = 1.0

        def running_cost(self, t, x, u):
            return self.weight * super().running_cost(t, x, u)

    value, slope = once(
        jax.value_and_grad(lambda w: jg.solve(Weighted(weight=w), method, throw=False).objective)
    )(1.0)
    # What four nodes leave between two points of the record.
    np.testing.assert_allclose([value, slope], LEAST, rtol=1e-6)


class Periodic(jg.Problem):
    """x' = -x + sin t over a period, x(2 pi) = x(0): (sin t - cos t)/2."""

    state_names = ("x",)
    initial_state = jg.Free()
    final_time = 2 * math.pi

    def dynamics(self, t, x, u):
        return -x + jnp.sin(t)

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf - x0


def test_periodic_ends():
    e = jg.solve(Periodic())
    np.testing.assert_allclose(e.x[0, 0], -0.5, rtol=1e-9)
    np.testing.assert_allclose(e.x[-1], e.x[0], atol=1e-12)
    np.testing.assert_allclose(e.x[:, 0], (np.sin(e.t) - np.cos(e.t)) / 2, atol=1e-8)


class Down(DoubleIntegrator):
    """To rest on the ground, which is a state bound and a path constraint as well; least cost 6."""

    state_bounds = ((0.0, -10.0), (10.0, 10.0))
    path_bounds = (0.0, math.inf)
    initial_state = (1.0, 0.0)
    target: tuple = (0.0, 0.0)

    def path_constraints(self, t, x, u):
        return x[:1] - 0.05 * x[1] ** 2


def test_constraints_that_meet_at_the_end():
    method = jg.Pseudospectral(nodes=6, segments=4, refinements=0)
    e = jg.solve(Down(), method)
    np.testing.assert_allclose(e.objective, 6.0, rtol=1e-8)
    # u = 12 t - 6 = -lambda_v and lambda_x = 12: the endpoint constraints alone hold the end.
    np.testing.assert_allclose(e.multipliers.endpoint, [12.0, -6.0], rtol=1e-6)
    assert float(jnp.abs(e.multipliers.state).max()) < 1e-6
    below = jg.solve(Down(target=(-1.0, 0.0)), method, throw=False)
    assert below.result != jg.RESULTS.successful


class Landing(jg.Problem):
    """Planar Mars landing: ground, glide slope and end say the same of the last node; -1506.9303
    from 300 segments."""

    full = 6 * 3100.0 * math.cos(math.radians(27.0))
    state_names = ("up", "north", "v_up", "v_north", "m")
    control_names = ("T_up", "T_north")
    initial_state = (1500.0, 2000.0, -75.0, 100.0, 1905.0)
    final_time = jg.Free(20.0, 150.0)
    state_bounds = ((0.0, -1e4, -500.0, -500.0, 1505.0), (5e3, 1e4, 500.0, 500.0, 1905.0))
    path_bounds = (((0.3 * full) ** 2, 0.0), ((0.8 * full) ** 2, math.inf))

    def dynamics(self, t, x, u):
        burnt = -jnp.sqrt(u @ u)[None] / (225.0 * 9.807 * math.cos(math.radians(27.0)))
        return jnp.concatenate([x[2:4], u / x[4] - jnp.array([3.7114, 0.0]), burnt])

    def path_constraints(self, t, x, u):
        slope = math.tan(math.radians(4.0)) * (jnp.sqrt(x[1] ** 2 + 1.0) - 1.0)
        return jnp.stack([u @ u, x[0] - slope])

    def endpoint_cost(self, x0, xf, t0, tf):
        return -xf[4]

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf[:4]


@pytest.mark.slow
def test_a_landing():
    e = jg.solve(Landing(), throw=False)
    np.testing.assert_allclose(e.objective, -1506.9303, rtol=1e-6)


class LeastTime(jg.Problem):
    """x'' = u, |u| <= 1, from (1, 1/2) to rest: tf = 1/2 + 2 sqrt(9/8). From a straight guess the
    search fails."""

    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (1.0, 0.5)
    final_time = jg.Free(0.1, 10.0, 3.0)
    control_bounds = (-1.0, 1.0)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0]])

    def endpoint_cost(self, x0, xf, t0, tf):
        return tf

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf


LEAST_TIME = 0.5 + 2 * math.sqrt(1.125)


def test_one_mesh_has_more_than_one_start():
    given = jg.Pseudospectral(fractions=tuple(np.linspace(0, 1, 13)), refinements=0)
    e = jg.solve(LeastTime(), given)  # no coarser mesh may be tried
    np.testing.assert_allclose(e.objective, LEAST_TIME, rtol=1e-3)  # what the mesh leaves


@pytest.mark.slow
def test_a_trace_has_more_than_one_start():
    again = once(lambda p: jg.solve(p, jg.Pseudospectral(), throw=False))
    e = again(LeastTime(initial_state=(jnp.array(1.0), jnp.array(0.5))))
    np.testing.assert_allclose(e.objective, LEAST_TIME, rtol=1e-3)
    assert e.result == jg.RESULTS.underresolved


def test_the_wall_is_named():
    class Beyond(Spring):
        initial_state = (10.0, 0.0)  # trough -4.443 at t = 3.24

    with pytest.raises(jg.SolveError, match=r"lower bound -4 of x at node \d+ \(t = 3\.[12]") as e:
        jg.solve(Beyond())
    assert "does not show that no trajectory exists" in str(e.value)


def test_what_stays_unresolved_says_so():
    method = jg.Pseudospectral(nodes=4, segments=2, refinements=1, mesh_tolerance=1e-12)
    with pytest.warns(jg.SolveWarning, match="Kink: The mesh does not resolve .* at t = "):
        e = jg.solve(Kink(), method)
    assert e.result == jg.RESULTS.underresolved
