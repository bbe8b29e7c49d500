"""The spectral algorithm: better meshes, structures, random starts, segments one by one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxguide as jg
from jaxguide import problems
from jaxguide.nominal.refinement.arcs import Arcs, _cut, without_collapsed
from jaxguide.nominal.refinement.meshes import moved

# What a fixed mesh of 12 segments of 6 Radau nodes leaves of the objective, from a straight line as
# guess, of one problem of each kind: each is a program of its own, and compiles for seconds.
KINDS = {
    "rayleigh": 1e-6, "isoperimetric": 1e-8, "jackson": 1e-5, "goddard": 1e-4, "robot-arm": 1e-4,
    "shuttle-reentry-heat": 1e-3,
}  # fmt: skip


def test_moved_mesh_goes_where_the_error_is():
    fractions, errors = np.linspace(0, 1, 11), np.full(10, 1e-9)
    errors[3] = 1e-2
    new = moved(fractions, errors, 10)
    assert new[0] == 0 and new[-1] == 1 and np.all(np.diff(new) > 0)
    inside = np.sum((new > 0.3) & (new < 0.4))
    assert inside >= 6


@pytest.mark.slow
@pytest.mark.parametrize(("name", "left"), KINDS.items())
def test_library_from_a_straight_line(name, left):
    e = jg.solve(problems.get(name), jg.Pseudospectral(refinements=0))
    np.testing.assert_allclose(e.objective, problems.reference(name).value, rtol=left)


@pytest.mark.slow
def test_structure_is_found_and_solved_exactly():
    steps = []
    e = jg.solve(problems.get("moon-lander"), jg.Pseudospectral(), watch=steps.append)
    assert steps[-2].step.startswith("structure"), list(map(str, steps))
    assert steps[-1].step.startswith("stopped, the structure is clear"), str(steps[-1])
    # Its conditions are met to 1e-11.
    np.testing.assert_allclose(e.objective, problems.reference("moon-lander").value, rtol=1e-11)
    assert bool(e.certificate.passed.all()), str(e.certificate)


@pytest.mark.slow
def test_two_switches_that_nodes_do_not_part():
    """NPSAT1: two of its 14 switches are 0.24 s apart, of 112 s. The multipliers part them; the
    optimum by Newton's method on the 14 switching times, flown by Richardson's extrapolation of
    Runge-Kutta 4, is 112.0520402913."""
    e = jg.solve(problems.get("npsat1"), jg.Pseudospectral())
    np.testing.assert_allclose(e.objective, 112.0520402913, rtol=1e-8)
    assert bool(e.certificate.passed.all()), str(e.certificate)


def test_arcs_of_labels():
    t = np.linspace(0, 1, 40)
    labels = np.where(t < 0.3, -1, 1)[:, None]
    labels[20] = 0  # the blur of a node
    found = _cut(t, labels)
    assert found.active.ravel().tolist() == [-1, 1]
    np.testing.assert_allclose(found.junctions, 0.3, atol=1 / 39)


def test_arcs_that_free_knots_closed_are_dropped():
    found = Arcs(np.array([0.5, 0.6, 0.8]), np.array([[-1], [0], [1], [0]]))
    kept = without_collapsed(found, np.array([0.0, 0.55, 0.550001, 0.8, 1.0]))
    assert kept.active.ravel().tolist() == [-1, 1, 0]
    np.testing.assert_allclose(kept.junctions, [0.5500005, 0.8])
    alike = Arcs(found.junctions[:2], np.array([[-1], [0], [-1]]))
    assert len(without_collapsed(alike, np.array([0.0, 0.55, 0.550001, 1.0])).junctions) == 0


@pytest.mark.slow
def test_random_starts_are_extremals_or_reasons():
    method = jg.Pseudospectral(nodes=5, segments=4, refinements=0)
    problem = problems.get("brachistochrone")
    found = [
        jg.solve(problem, method, guess=jax.random.key(k), throw=False).objective for k in range(4)
    ]
    best = jg.solve(problem, dataclasses.replace(method, starts=4))
    assert float(best.objective) <= min(map(float, found)) + 1e-9


@pytest.mark.slow
def test_npsat1_on_one_segment():
    # reference/pseudospectral.md: CasADi + IPOPT, N = 40, from any guess.
    e = jg.solve(problems.get("npsat1"), jg.Pseudospectral("lgl", 41, 1, refinements=0))
    np.testing.assert_allclose(e.objective, 112.2088, atol=5e-5)


@pytest.mark.slow
def test_bellman_segments_do_not_add_up_errors():
    problem = problems.get("brachistochrone")
    method = jg.Pseudospectral("lgl", 7, 1, refinements=0)

    def miss(segments):
        b = jg.bellman(problem, method, segments)
        assert bool(b.result == jg.RESULTS.successful)
        end = problem.endpoint_constraints(b.x[0], b.x[-1], b.t[0], b.t[-1])
        return float(jnp.max(jnp.abs(end)))

    # What remains is half as long, so its interpolation error a 2^5th of that of the whole, which
    # is well above that of the solver.
    whole = miss(1)
    assert whole > 1e-8 and miss(2) < whole / 8
