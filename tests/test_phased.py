"""Phases one after another: linked, with jumps, staged."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator

import jaxguide as jg
from jaxguide import problems
from jaxguide.problems import EarthMars


@pytest.mark.slow
def test_phases():
    """The moon lander as a fall and a burn, linked; each phase has its own extremal and clock."""

    class Fall(problems.MoonLander):
        control_bounds = (0.0, 0.0)
        final_time = jg.Free(0.1, 3.0, 1.0)

        def endpoint_constraints(self, x0, xf, t0, tf):
            return jnp.zeros(0)

    class Burn(problems.MoonLander):
        initial_state = None
        control_bounds = (3.0, 3.0)
        final_time = jg.Free(1.0, 10.0, 3.0)

    phased = jg.Phased((Fall(), Burn()))
    e = jg.solve(phased, jg.Pseudospectral(nodes=4, segments=1, refinements=0))
    np.testing.assert_allclose(e.objective, problems.reference("moon-lander").value, rtol=1e-9)
    fall, burn = phased.split(e)
    # Coast for (sqrt 68 - 4)/3, then the burn lasts 4/3 longer.
    switch = (np.sqrt(68) - 4) / 3
    np.testing.assert_allclose(fall.final_time, switch, rtol=1e-8)
    np.testing.assert_allclose(burn.final_time, 2 * switch + 4 / 3, rtol=1e-8)
    np.testing.assert_allclose(burn.x[0], fall.x[-1], atol=1e-9)
    np.testing.assert_allclose(burn.costate[0], fall.costate[-1], atol=1e-7)
    for phase in (e, fall, burn):  # transversality of the fall by what pulls at its end
        assert bool(phase.certificate.passed.all()), str(phase.certificate)
    assert "static parameters" in e.certificate.names  # both durations


@pytest.mark.slow
def test_goddard_in_three_phases():
    """Boost, singular arc, coast: with the singular control kept smooth, the optimum to what is
    known of it; where it is not, the control oscillates and overshoots it by 2e-5."""

    class Boost(problems.Goddard):
        control_bounds = (1.0, 1.0)
        final_time = jg.Free(0.005, 0.1, 0.02)

        def endpoint_cost(self, x0, xf, t0, tf):
            return 0.0

        def endpoint_constraints(self, x0, xf, t0, tf):
            return jnp.zeros(0)

    class Singular(Boost):
        control_bounds = (0.0, 1.0)
        initial_state = None
        initial_time = jg.Free(0.005, 0.1, 0.02)
        final_time = jg.Free(0.03, 0.2, 0.07)

    class Coast(problems.Goddard):
        control_bounds = (0.0, 0.0)
        initial_state = None
        initial_time = jg.Free(0.03, 0.2, 0.07)
        final_time = jg.Free(0.1, 0.4, 0.2)
        state_bounds = ((1.0, -1.0, 0.5), (2.0, 2.0, 1.0))  # the mass stays at its end value, 0.6

    method = jg.Pseudospectral(nodes=12, segments=1, refinements=0, smoothing=(0.0, 100.0, 0.0))
    e = jg.solve(jg.Phased((Boost(), Singular(), Coast())), method)
    known = problems.reference("goddard")
    np.testing.assert_allclose(e.objective, known.value, atol=known.uncertainty)


class First(DoubleIntegrator):
    """Half the way of the double integrator, without an end of its own."""

    final_time = 0.5

    def endpoint_constraints(self, x0, xf, t0, tf):
        return jnp.zeros(0)


class Second(DoubleIntegrator):
    initial_state = None
    final_time = 1.0


SMALL = jg.Pseudospectral(nodes=4, segments=1, refinements=0)


def test_phases_that_do_not_join_are_refused():
    with pytest.raises(ValueError, match="say in `links` how they join"):
        jg.Phased((DoubleIntegrator(), EarthMars()))
    with pytest.raises(ValueError, match="give at least two"):
        jg.Phased((DoubleIntegrator(),))
    with pytest.raises(ValueError, match=r"phase 2, Second, starts at 1.0 and ends at 1.0"):
        jg.Phased((First(final_time=1.0), Second()))
    with pytest.raises(ValueError, match="initial_state has 1 entries for 2 states"):
        jg.Phased((First(initial_state=(0.0,)), Second()))

    def cost(jump):
        return jg.Phased((First(), Second()), lambda ends: ends[1].x0 - ends[0].xf - jump).n * 1.0

    with pytest.raises(ValueError, match="closes over a traced number"):
        jax.grad(cost)(0.5)


@pytest.mark.slow
def test_phases_are_edited_where_they_are():
    phased = jg.Phased((First(), Second()))
    with pytest.raises(TypeError, match="control_bounds"):
        dataclasses.replace(phased, control_bounds=(-1.0, 1.0))
    where = lambda p: (p.phases[0].initial_state, p.phases[0].control_bounds)
    moved = eqx.tree_at(where, phased, ((0.5, 0.0), (-2.5, 2.5)))
    assert moved.initial_state[:2] == (0.5, 0.0)
    np.testing.assert_array_equal(moved.control_bounds[1], [2.5, np.inf])
    # From half way, u = 3 - 6 t but for the bound: the first phase flies at 2.5 at most.
    free = jg.solve(
        dataclasses.replace(phased, phases=(First(initial_state=(0.5, 0.0)), Second())), SMALL
    )
    np.testing.assert_allclose(free.objective, 1.5, rtol=1e-9)
    held = jg.solve(moved, SMALL)
    assert held.objective > 1.5 + 1e-3 and held.u[:, 0].max() <= 2.5


class Timed(First):
    """As `First`, its final time a property."""

    share: float = 0.5

    @property
    def final_time(self):
        return self.share


@pytest.mark.slow
def test_a_phase_whose_final_time_is_a_property():
    phased = jg.Phased((Timed(), Second()))
    e = jg.solve(phased, jg.Pseudospectral(nodes=6, segments=1, refinements=0))
    np.testing.assert_allclose(e.objective, 6.0, rtol=1e-9)
    for phase, (a, b) in zip(phased.split(e), ((0.0, 0.5), (0.5, 1.0)), strict=True):
        times = (phase.t[0], phase.t[-1], phase.problem.final_time)
        np.testing.assert_allclose(times, (a, b, b), rtol=0, atol=1e-15)
        assert bool(phase.certificate.passed.all()), str(phase.certificate)


class Jump(eqx.Module):
    """The second phase starts `by` further on."""

    by: float

    def __call__(self, ends):
        ahead = jnp.stack([jnp.asarray(self.by), jnp.zeros(())])
        return ends[1].x0 - ends[0].xf - ahead


def cost(by):
    """J = 6 (1 - by)^2: the rest of the way."""
    return jg.solve(jg.Phased((First(), Second()), Jump(by)), SMALL, throw=False).objective


@pytest.mark.slow
def test_a_jump_of_the_state_by_links():
    np.testing.assert_allclose(jax.value_and_grad(cost)(0.5), (1.5, -6.0), rtol=1e-8)


@pytest.mark.slow  # a program of half a minute
def test_derivatives_of_phases_mapped():
    costs, slopes = jax.vmap(jax.value_and_grad(cost))(jnp.array([0.0, 0.5]))
    np.testing.assert_allclose(costs, [6.0, 1.5], rtol=1e-9)
    np.testing.assert_allclose(slopes, [-12.0, -6.0], rtol=1e-8)


@pytest.mark.slow
def test_four_stages_to_orbit():
    """Delta III without a guess: 12 segments of 6 nodes do not find in, 3 segments lead there. The
    barrier leaves 480 directions short of length one: 1e-10 of 24 t each, 1.5e-7 of the mass."""
    e = jg.solve(problems.get("delta-iii"), jg.Pseudospectral())
    known = problems.reference("delta-iii")
    np.testing.assert_allclose(e.objective, known.value, rtol=2e-7)
    assert bool(e.certificate.passed.all()), str(e.certificate)


def test_phases_share_a_parameter():
    """x' = -k x + u over two phases, least int u^2 + (k - 1)^2/2 and the end held: one k for both,
    and not one each."""

    class Decay(jg.Problem):
        k: Any = jg.Free(0.0, 5.0, 1.0)
        state_names = ("x",)
        control_names = ("u",)
        initial_state = (1.0,)
        final_time = 1.0

        def dynamics(self, t, x, u):
            return -self.k * x + u

        def running_cost(self, t, x, u):
            return u[0] ** 2

        def endpoint_cost(self, x0, xf, t0, tf):
            return (self.k - 1) ** 2 / 2

    class Later(Decay):
        initial_state = None
        final_time = 2.0

        def endpoint_constraints(self, x0, xf, t0, tf):
            return xf - 0.05

    class Whole(Decay):
        final_time = 2.0

        def endpoint_cost(self, x0, xf, t0, tf):
            return (self.k - 1) ** 2

        def endpoint_constraints(self, x0, xf, t0, tf):
            return xf - 0.05

    method = jg.Pseudospectral(nodes=8, segments=2, refinements=0)
    phased = jg.Phased((Decay(), Later()), shared=("k",))
    assert phased.parameter_paths() == (("phases", 0, "k"),)
    e, whole = jg.solve(phased, method), jg.solve(Whole(), method)
    np.testing.assert_allclose(e.objective, whole.objective, rtol=1e-8)
    first, second = phased.split(e)
    solved: Any = (e.problem, whole.problem, first.problem, second.problem)
    k = solved[0].phases[0].k
    np.testing.assert_allclose(k, solved[1].k, rtol=1e-6)
    assert solved[2].inner.k == k and solved[3].k == k
    assert bool(e.certificate.passed.all()), str(e.certificate)
    with pytest.raises(ValueError, match="shared has 'mass'"):
        jg.Phased((Decay(), Later()), shared=("mass",))
