"""The extremal of a structure: arcs between free knots and kinks, each control on its bound or
smooth.

**Source:** review, section 4.4 and the remarks on knots.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxguide.nominal.defects import segment_errors
from jaxguide.nominal.method import run_on_host
from jaxguide.nominal.refinement.arcs import Arcs, corrected, meeting_points, without_collapsed
from jaxguide.nominal.refinement.layout import affine_controls, inner_breaks, laid_out
from jaxguide.nominal.refinement.meshes import MeshStep, remeshed, split
from jaxguide.nominal.refinement.soundness import worst_bound_errors
from jaxguide.problem import Problem
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import Endless
from jaxguide.types import succeeded

_MOST_JUNCTIONS = 24  # more are chattering, or a singular arc's noise (Fuller's problem)
# Complementarity of a structure, relative to H: up to RIGHT it is right, beyond WRONG it is wrong.
# In between an arc is missing or one too many: better than a mesh, but a finer mesh may tell which.
# First choices, tried on some ten problems of the library.
RIGHT, WRONG = 1e-5, 1e-2
_SOUND, _CORRECTIONS = 1e-7, 4  # below _SOUND no multiplier asks for another structure
BEYOND = 1e-6  # by how much, of its size, a bound may be overstepped between nodes
EXACT = 1e-11  # tolerance of the first-order conditions, so that the barrier does not show
_NODES = 12  # of a segment of the mesh with free knots: a first choice, tried on ten problems
# Meshes of one structure: kinks come as near as rounding in three to five, and arcs whose error is
# above the tolerance are halved at the same time.
_MOST_MESHES, _MOST_SEGMENTS = 7, 96
# Of the horizon: a kink that moves less is found. The multiplier of the bound is zero there to as
# much of its largest value. A choice, well above rounding.
_FOUND = 1e-9


class _Structure(NamedTuple):
    """Arcs, and the breaks inside each of them from 0 to 1 of it. `loose`: whether controls that
    are on no bound have none, in which H is not linear: no barrier then pushes them."""

    found: Arcs
    inner: list[np.ndarray]
    loose: bool = False


class _Solved(NamedTuple):
    """The extremal of a structure. `ends`: of its arcs; `edges`: their numbers among the breaks."""

    extremal: Extremal
    ends: Float[np.ndarray, " end"]
    edges: Any
    errors: Float[np.ndarray, " segment"]


def structured(
    method: Any,
    problem: Problem,
    extremal: Extremal,
    found: Arcs,
    marks: Float[np.ndarray, " mark"],
    watch: Callable[[MeshStep], None],
) -> tuple[Extremal, float]:
    """The extremal of the structure `found`, and how wrong that structure is: its complementarity,
    infinite where the structure is not clear, not resolved or not feasible.

    Switches are free knots. A kink, where a control meets its bound without a jump, hardly matters
    to the objective, which changes by the third power of its displacement: it is put where the
    bound's multiplier vanishes, mesh after mesh. Arcs that close are dropped. Where multipliers of
    the wrong sign show which arc is wrong, the structure is corrected by them, as long as that
    makes it less wrong. `marks`: fractions of the horizon at which there must be breaks besides.
    """
    clear = 0 < len(found.junctions) <= _MOST_JUNCTIONS and found.switches(problem.m).any()
    if not clear or isinstance(problem, Endless):
        return extremal, np.inf
    affine = affine_controls(extremal)
    solve = lambda near, found: _settled(method, problem, near, found, affine, marks, watch)
    best, found, ends, wrong = solve(extremal, found)
    for _ in range(_CORRECTIONS):
        if not _SOUND < wrong < WRONG:
            break
        better = corrected(best, found, ends, affine)
        if len(better.junctions) <= len(found.junctions):
            break
        other, better, ends, less = solve(best, better)
        if less >= wrong:
            break
        best, found, wrong = other, better, less
    return best, wrong


def _settled(
    method: Any,
    problem: Problem,
    extremal: Extremal,
    found: Arcs,
    affine: np.ndarray,
    marks: np.ndarray,
    watch: Callable[[MeshStep], None],
) -> tuple[Extremal, Arcs, np.ndarray, float]:
    """The extremal of `found` once its kinks have settled and its arcs are resolved, with its arcs,
    their ends, and how wrong it is."""
    at = _Structure(found, inner_breaks(extremal, found, affine))
    ends, wrong = np.zeros(0), np.inf
    for _ in range(_MOST_MESHES):
        solved = _solved(method, problem, extremal, at, affine, marks)
        exact, ends = solved.extremal, solved.ends
        error = float(solved.errors.max())
        if not succeeded(exact.result):
            watch(MeshStep("structure not found", exact, error))
            return extremal, at.found, ends, np.inf
        extremal = exact
        kept = without_collapsed(at.found, ends)
        if len(kept.junctions) < len(at.found.junctions):
            watch(MeshStep("arcs closed", exact, error))
            if not len(kept.junctions):
                return exact, kept, ends, np.inf
            at = _Structure(kept, inner_breaks(exact, kept, affine))
            continue
        wrong = _wrongness(exact)
        following, settled = _following(at, solved, affine, method.mesh_tolerance)
        watch(MeshStep(f"structure, complementarity {wrong:.0e}", exact, error))
        if settled:
            found = at.found._replace(junctions=ends[1:-1])
            exact, wrong = _without_barrier(method, problem, exact, at, affine, marks, watch)
            return exact, found, ends, wrong
        if following is None:
            break
        at = following
    return extremal, at.found, ends, np.inf


def _without_barrier(
    method: Any,
    problem: Problem,
    exact: Extremal,
    at: _Structure,
    affine: np.ndarray,
    marks: np.ndarray,
    watch: Callable[[MeshStep], None],
) -> tuple[Extremal, float]:
    """`exact`, solved once more without the bounds that its controls are not on, and how wrong it
    is; itself where controls then leave them."""
    wrong = _wrongness(exact)
    free = at.found.active[:, : len(affine)] == 0
    if not np.isfinite(wrong) or not np.any(free & ~affine):
        return exact, wrong
    solved = _solved(method, problem, exact, at._replace(loose=True), affine, marks)
    less, error = _wrongness(solved.extremal), float(solved.errors.max())
    watch(MeshStep(f"without barrier, complementarity {less:.0e}", solved.extremal, error))
    good = succeeded(solved.extremal.result) and error <= method.mesh_tolerance
    return (solved.extremal, less) if good and less <= wrong else (exact, wrong)


def _following(
    at: _Structure, solved: _Solved, affine: np.ndarray, tolerance: float
) -> tuple[_Structure | None, bool]:
    """The structure with its kinks moved and its arcs of large errors divided, if there is room;
    and whether there was no need."""
    found, ends = at.found._replace(junctions=solved.ends[1:-1]), solved.ends
    junctions = meeting_points(solved.extremal, found, solved.edges, found.kinks(affine))
    junctions = np.maximum.accumulate(junctions)
    still = np.abs(junctions - found.junctions).max() <= _FOUND * np.ptp(ends)
    poor = solved.errors > tolerance
    breaks, inner, divided = np.asarray(solved.extremal.breaks), [], False
    for arc, (a, b) in enumerate(zip(solved.edges[:-1], solved.edges[1:], strict=True)):
        singular = np.any(affine & (found.active[arc, : len(affine)] == 0))
        if singular or not poor[a:b].any():  # a singular arc has one polynomial
            inner.append(at.inner[arc])
            continue
        here = (breaks[a : b + 1] - breaks[a]) / (breaks[b] - breaks[a])
        inner.append(split(here, poor[a:b]))
        divided = True
    if still and not divided:
        return None, not poor.any()
    if np.sum(poor) + len(poor) > _MOST_SEGMENTS:
        return None, False
    kept = without_collapsed(found, np.concatenate([ends[:1], junctions, ends[-1:]]))
    if len(kept.junctions) == len(found.junctions):
        return _Structure(found._replace(junctions=junctions), inner), False
    if not len(kept.junctions):
        return None, False
    return _Structure(kept, inner_breaks(solved.extremal, kept, affine)), False


def _solved(
    method: Any,
    problem: Problem,
    extremal: Extremal,
    at: _Structure,
    affine: np.ndarray,
    marks: np.ndarray,
) -> _Solved:
    """The solution on the mesh of a structure, to EXACT if that converges."""
    mesh = laid_out(extremal, at.found, affine, at.inner, marks, at.loose)
    asked = method.tolerance
    sharp = dataclasses.replace(method, tolerance=min(asked, EXACT))
    knotted = remeshed(sharp, mesh.fractions, _NODES, mesh.knots, mesh.arcwise)
    exact = run_on_host(knotted, problem, extremal)
    if not succeeded(exact.result):
        exact = run_on_host(dataclasses.replace(knotted, tolerance=asked), problem, exact)
    ends = np.asarray(exact.breaks)[mesh.edges]
    return _Solved(exact, ends, mesh.edges, np.asarray(segment_errors(exact)))


def _wrongness(exact: Extremal) -> float:
    """Its complementarity; infinite where a bound is overstepped between nodes."""
    over, complementarity = (float(v) for v in worst_bound_errors(exact))
    return complementarity if over <= BEYOND else np.inf
