"""Bounds of every kind, active: closed forms, derivatives by them, certificates, units."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator, FreeTime, once

import jaxguide as jg


class Bounded(jg.Problem):
    """Uncoupled parts, each held by a bound of its own, over a horizon that wants to be shorter:

    - a: from rest to rest over 1, int a dt = `area`; b: as far as `reach` at least; c: to 1 from a
      start within `start`; each with int u^2/2, three double integrators;
    - p' = w with w >= `push`; r' = w with w >= `pull` as a control bound; s' = w from `wall`, drawn
      to 2 but kept there.

    All polynomials: exact on one segment.
    """

    area: float = 0.4
    reach: float = 0.8
    start: float = 0.3
    push: float = 0.5
    pull: float = 0.7
    wall: float = 1.2
    least: float = 1.5
    state_names = ("a", "a'", "b", "b'", "c", "c'", "p", "r", "s")
    control_names = ("u_a", "u_b", "u_c", "u_p", "u_r", "u_s")

    @classmethod
    def of(cls, area, reach, start, push, pull, wall, least):
        infinite = jnp.full(9, jnp.inf)
        end = jnp.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
        return cls(
            area, reach, start, push, pull, wall, least,
            final_time=jg.Free(least, 10.0, 3.0),
            initial_state=(0.0, 0.0, 0.0, 0.0, jg.Free(-1.0, start), 0.0, 0.0, 0.0, wall),
            state_bounds=(-jnp.inf, infinite.at[8].set(wall)),
            control_bounds=(-infinite[:6].at[4].set(-pull), jnp.inf),
            path_bounds=(push, jnp.inf),
            endpoint_bounds=(end.at[2].set(reach), end.at[2].set(jnp.inf)),
            integral_bounds=(area, area),
        )  # fmt: skip

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0], x[3], u[1], x[5], u[2], u[3], u[4], u[5]])

    def running_cost(self, t, x, u):
        return 100.0 + jnp.sum(u**2) / 2 + (x[8] - 2) ** 2 / 2

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf[:6]

    def path_constraints(self, t, x, u):
        return u[3:4]

    def integrands(self, t, x, u):
        return x[:1]


def closed_form(area, reach, start, push, pull, wall, least):
    T = least
    a = 6 / T**3 + 360 * (area - T / 2) ** 2 / T**5
    others = 6 * (reach**2 + (1 - start) ** 2) / T**3
    return 100 * T + a + others + (push**2 + pull**2 + (2 - wall) ** 2) * T / 2


@pytest.mark.slow
def test_derivatives_with_respect_to_bounds_of_every_kind():
    values = jnp.array([0.4, 0.8, 0.3, 0.5, 0.7, 1.2, 1.5])
    method = jg.Pseudospectral(nodes=6, segments=1, refinements=0)
    solved = lambda v: jg.solve(Bounded.of(*v), method, throw=False)

    def both(v):
        e = solved(v)
        return e.objective, e

    (cost, e), slopes = once(jax.value_and_grad(both, has_aux=True))(values)
    wanted, wanted_slopes = jax.value_and_grad(lambda v: closed_form(*v))(values)
    # The optimiser's bounds have 1e-9 of room, by which slopes change as much times slope''/slope,
    # at most 22 (of the area).
    np.testing.assert_allclose(cost, wanted, rtol=1e-9)
    np.testing.assert_allclose(slopes, wanted_slopes, rtol=2.2e-8)
    assert bool(e.certificate.passed.all()), str(e.certificate)

    # Every covector of a bound has its sign, and none stands where there is no bound.
    failed = lambda e: {r["check"] for r in e.certificate.rows() if not r["passed"]}
    stated = lambda **changed: dataclasses.replace(
        e, problem=dataclasses.replace(e.problem, **changed)
    )
    turned = eqx.tree_at(lambda e: e.multipliers.endpoint, e, -e.multipliers.endpoint)
    assert "complementarity, ends" in failed(turned)
    assert "H at the end" in failed(stated(final_time=jg.Free(0.1, 10.0)))
    entries = e.problem.initial_state
    further = (*entries[:4], jg.Free(-1.0, 0.9), *entries[5:])
    assert "transversality, start" in failed(stated(initial_state=further))
    assert "integral constraints" in failed(stated(integral_bounds=(0.41, 0.41)))


def capped(length, time, cap):
    bound = cap * length / time**2
    return DoubleIntegrator(target=(length, 0.0), final_time=time, control_bounds=(-bound, bound))


@pytest.mark.parametrize("cap", [5.0, np.inf])
@pytest.mark.slow
def test_any_units(cap):
    """A double integrator in lengths from 1e-9 to 1e7 and times from 1e-4 to 1e6, where v and u are
    known by neither bounds nor ends: all is what it is in units of one."""
    method = jg.Pseudospectral(nodes=6, segments=4, refinements=0)
    unit = jg.solve(capped(1.0, 1.0, cap), method)
    for length, time in ((1e-9, 1e6), (1e-4, 1e3), (1e4, 1.0), (1e7, 1e-4)):
        e = jg.solve(capped(length, time, cap), method)
        # The same iterations but for rounding: a thousand operations deep.
        np.testing.assert_allclose(e.objective * time**3 / length**2, unit.objective, rtol=1e-12)
        assert list(e.certificate.passed) == list(unit.certificate.passed), str(e.certificate)
        value = lambda e: np.asarray(e.certificate.value)[np.asarray(e.certificate.value) > 1e-6]
        np.testing.assert_allclose(value(e), value(unit), rtol=1e-11)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (0.0, jg.Free()),
        (jg.Free(0.0, 10.0), jg.Free(0.0, 10.0)),
        (jg.Free(), 5.0),
    ],
)
@pytest.mark.slow
def test_horizons_stay_positive(start, end):
    """Unbounded ends once ran to t = -7, and two guesses of 5 made no horizon."""
    method = jg.Pseudospectral(nodes=6, segments=2, refinements=0)
    e = jg.solve(FreeTime(initial_time=start, final_time=end), method)
    np.testing.assert_allclose(e.t[-1] - e.t[0], 18**0.25, rtol=1e-8)
