"""The spectral algorithm around a direct solve: what to try next, and when to stop. Host only.

**Source:** review, section 4.4 and the remarks on knots.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxguide.nominal.defects import segment_errors
from jaxguide.nominal.method import run_on_host
from jaxguide.nominal.refinement.arcs import Arcs, arcs
from jaxguide.nominal.refinement.layout import without_idle_bounds
from jaxguide.nominal.refinement.marks import marks_of, settled
from jaxguide.nominal.refinement.meshes import (
    MeshStep,
    fractions_of,
    moved,
    remeshed,
    tails,
    united,
)
from jaxguide.nominal.refinement.soundness import worst_bound_errors
from jaxguide.nominal.refinement.structured import BEYOND, EXACT, RIGHT, WRONG, structured
from jaxguide.problem import Problem
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import Endless
from jaxguide.types import RESULTS, succeeded

# Largest mesh: 14 nodes keep the extrapolation to a segment's end harmless, 96 segments solve in a
# tenth of a second. First choices, tried on the library.
_MOST_NODES, _MOST_SEGMENTS = 14, 96
_MOST_MOVES = 6  # of the breaks of one size of mesh: more helped on no problem of the library
_ATTEMPTS = 3  # meshes on which a structure is looked for

_MOST_LOOKS = 6  # for kinks and touching points: each leaves the square of their displacement
_MOVED = "breaks moved"
_SETTLED = 1e-8  # of the horizon: a touching point that moves less is found. Chosen, not tuned.
_NONE = np.zeros(0)


class _Standing(NamedTuple):
    """Where refinement stands.

    `method`: with the mesh last solved on; `extremal`: the last that was found; `mesh`: the method
    whose mesh `best`, the one of least error, is on. `worst`: the error when breaks last moved on a
    mesh of this size, `moves` times; `raised`: how often the mesh was enlarged; `tried`: on which
    of these a structure was tried; `known`: what its arcs held. `given`: breaks that the user gave,
    as fractions; `marks`: those at kinks and touching points, looked for `looked` times.
    """

    method: Any
    mesh: Any
    extremal: Extremal
    best: Extremal
    worst: float = np.inf
    moves: int = 0
    raised: int = 0
    tried: int = -1
    known: np.ndarray | None = None
    given: np.ndarray = _NONE
    marks: np.ndarray = _NONE
    looked: int = 0

    @property
    def kept(self) -> bool:
        """Whether the user has stated what each segment is: then none is moved or divided."""
        return bool(self.method.knots) or self.method.arcwise is not None

    @property
    def fixed(self) -> np.ndarray:
        """Breaks that stay where they are."""
        return np.unique(np.concatenate([self.given, self.marks]))


class _View(NamedTuple):
    """An extremal as the next decision looks at it."""

    errors: np.ndarray  # by segment
    arcs: Arcs
    resolved: bool  # errors below the mesh tolerance
    smooth: bool  # no junctions, and room for more nodes
    marks: np.ndarray  # breaks wanted at kinks and touching points, where they are not yet
    move: bool  # breaks may move once more, which costs no compilation, for as long as it helps


class _Next(NamedTuple):
    """The next mesh: its name for `watch`, its size, and where refinement then stands."""

    step: str
    segments: int
    nodes: int
    standing: _Standing
    fractions: np.ndarray | None = None  # where the breaks are; by default where the errors are


def refined(
    method: Any,
    problem: Problem,
    extremal: Extremal,
    watch: Callable[[MeshStep], None] | None = None,
) -> Extremal:
    """`extremal` again on better meshes, each from the last, until state and costate are resolved
    to `mesh_tolerance` or the refinements are used up; where a solve fails, the next mesh is
    tried. The best is returned: `RESULTS.underresolved` if its error is above the tolerance.
    `watch` is called with every mesh, and last with the reason to stop.

    First the breaks move to where the error is, and to kinks of the problem's functions and points
    where a bound is just touched; those that the user gave stay. Then, where controls meet bounds,
    the junctions become breaks and the controls stay on their bounds between them: exact to
    rounding if that is the structure, and taken only if its bounds and multipliers agree. A smooth
    solution gets more nodes, any other more segments. The last mesh is solved once more, to 1e-11:
    a barrier at `tolerance` shows in the covectors of bounds nearby.
    """
    if not method.refinements:
        return extremal
    hear = (lambda _: None) if watch is None else watch

    def stopped(why: str, last: Extremal) -> Extremal:
        error = _error(last)
        if succeeded(last.result) and not error <= method.mesh_tolerance:
            last = dataclasses.replace(last, result=RESULTS.underresolved)
        hear(MeshStep(f"stopped, {why}", last, error))
        return last

    hear(MeshStep("first mesh", extremal, _error(extremal)))
    given = _NONE if method.fractions is None else np.asarray(method.fractions, float)[1:-1]
    at = _Standing(method, method, extremal, extremal, given=given)
    candidate, doubt = None, np.inf
    while True:
        errors = np.asarray(segment_errors(at.extremal))
        if not succeeded(at.extremal.result) or not np.all(np.isfinite(errors)):
            return stopped("for the solve failed", at.best)
        view = _viewed(at, errors)
        if _may_be_structured(at, view):
            exact, wrong = structured(method, problem, at.extremal, view.arcs, at.fixed, hear)
            known = view.arcs.active if np.isfinite(wrong) else None
            at = at._replace(tried=at.raised, known=known)
            if wrong <= RIGHT:
                count = len(view.arcs.junctions)
                return stopped(f"the structure is clear: {count} junctions", exact)
            if wrong <= WRONG and wrong < doubt:
                candidate, doubt = exact, wrong
        following = _next_mesh(at, view)
        if isinstance(following, str):
            break
        at = _taken(following, problem, errors, hear, candidate)
    if candidate is None:
        return stopped(following, _sharpened(at, problem))
    why = f"{following}; the structure found stands, complementarity {doubt:.0e}"
    return stopped(why, candidate)


def _error(extremal: Extremal) -> float:
    return float(np.max(segment_errors(extremal)))


def _viewed(at: _Standing, errors: np.ndarray) -> _View:
    found = arcs(at.extremal)
    resolved = bool(errors.max() <= at.method.mesh_tolerance)
    smooth = at.kept or not len(found.junctions)
    smooth = smooth and at.method.nodes < _MOST_NODES
    if at.kept:
        return _View(errors, found, resolved, smooth, _NONE, False)
    move = not (smooth and resolved) and at.moves < _MOST_MOVES
    move = move and bool(errors.max() < 0.5 * at.worst)
    return _View(errors, found, resolved, smooth, _marks(at, errors, resolved), move)


def _marks(at: _Standing, errors: np.ndarray, resolved: bool) -> np.ndarray:
    """Breaks wanted at kinks and touching points where there are none yet."""
    if at.looked >= _MOST_LOOKS:
        return _NONE
    if not resolved:
        new = marks_of(at.extremal, errors, at.method.mesh_tolerance)
        if len(new):
            return new
    if not len(at.marks):
        return _NONE
    touching = settled(at.extremal, at.marks)
    return touching[np.abs(touching - at.marks) > _SETTLED]


def _may_be_structured(at: _Standing, view: _View) -> bool:
    """Whether its arcs are worth a solve of their own: the breaks have settled, they were not tried
    on too many meshes before, and are not what was tried last."""
    if at.kept or (at.known is not None and np.array_equal(at.known, view.arcs.active)):
        return False
    settled = bool(at.moves or view.resolved) and not (view.move and at.moves < 2)
    return settled and at.tried < min(at.raised, _ATTEMPTS - 1)


def _next_mesh(at: _Standing, view: _View) -> _Next | str:
    """The next mesh, or why there is none."""
    method, short = at.method, f"not resolved to {at.method.mesh_tolerance:g}"
    if view.resolved and len(view.arcs.junctions):
        return "states resolved; junctions remain between nodes"
    if view.resolved and float(tails(at.extremal)) <= method.mesh_tolerance:
        return "states and costates resolved"
    segments = len(at.extremal.breaks) - 1
    if len(view.marks):
        return _marked(at, view)
    if view.move:
        again = at._replace(worst=view.errors.max(), moves=at.moves + 1)
        return _Next(_MOVED, segments, method.nodes, again)
    if at.raised == method.refinements:
        return f"{short} after {at.raised} refinements"
    larger = at._replace(worst=np.inf, moves=0, raised=at.raised + 1)
    if view.smooth:
        same = fractions_of(at.extremal) if at.kept else None
        return _Next("more nodes", segments, min(method.nodes + 4, _MOST_NODES), larger, same)
    if 2 * segments <= _MOST_SEGMENTS and not at.kept:
        return _Next("more segments", 2 * segments, method.nodes, larger)
    return f"{short} on the largest mesh"


def _marked(at: _Standing, view: _View) -> _Next:
    """The mesh with breaks at kinks and touching points. One found again nearby replaces the last
    estimate of it."""
    fractions = fractions_of(at.extremal)
    # Less than half a segment away it is the same one.
    half = np.interp(at.marks, (fractions[1:] + fractions[:-1]) / 2, np.diff(fractions) / 2)
    far = np.abs(at.marks[:, None] - view.marks[None]).min(axis=1, initial=np.inf) > half
    own = fractions[np.isin(fractions, at.marks[~far], invert=True)]
    marks = np.union1d(at.marks[far], view.marks)
    standing = at._replace(marks=marks, looked=at.looked + 1, worst=np.inf)
    mesh = united(own, standing.fixed)
    return _Next(
        "breaks at kinks and touching points", len(mesh) - 1, at.method.nodes, standing, mesh
    )


def _taken(
    following: _Next,
    problem: Problem,
    errors: np.ndarray,
    hear: Callable[[MeshStep], None],
    candidate: Extremal | None,
) -> _Standing:
    """Where refinement stands after the next mesh, solved from the structure found so far, or from
    the last mesh. Where that fails, this size of mesh has had its turn."""
    at = following.standing
    fractions = following.fractions
    if fractions is None:
        fractions = moved(fractions_of(at.extremal), errors, following.segments, at.fixed)
    knots, arcwise = at.method.knots, at.method.arcwise
    method = remeshed(at.method, fractions, following.nodes, knots, arcwise)
    better = run_on_host(method, problem, at.extremal if candidate is None else candidate)
    error = _error(better)
    hear(MeshStep(following.step, better, error))
    if not succeeded(better.result):
        return at._replace(method=method, moves=_MOST_MOVES, looked=_MOST_LOOKS)
    at = at._replace(method=method)
    if following.step == _MOVED and error >= errors.max():
        return at
    # Resolved is resolved: then the later, finer mesh.
    least = max(_error(at.best), method.mesh_tolerance)
    at = at._replace(extremal=better)
    return at._replace(best=better, mesh=method) if error <= least else at


def _sharpened(at: _Standing, problem: Problem) -> Extremal:
    """The best extremal, solved once more to EXACT, and once more without the bounds that it keeps
    away from, whose barrier would show in costates and multipliers; itself where that fails, or
    where chattering would use the room between the nodes."""
    tolerance = min(at.mesh.tolerance, EXACT)
    sharp = dataclasses.replace(at.mesh, starts=1, tolerance=tolerance)
    allowed = max(_error(at.best), at.method.mesh_tolerance)
    good = lambda e: succeeded(e.result) and _error(e) <= allowed
    exact = run_on_host(sharp, problem, at.best)
    exact = exact if good(exact) else at.best
    loosened = None if at.kept else without_idle_bounds(exact)
    if loosened is None or isinstance(problem, Endless):
        return exact
    fractions = fractions_of(exact)
    method = remeshed(sharp, fractions, sharp.nodes, (), loosened)
    free = run_on_host(method, problem, exact)
    return free if good(free) and max(worst_bound_errors(free)) <= BEYOND else exact
