"""The spectral algorithm around a direct solve: better meshes, junctions as free knots, and when to
stop. Host only.

**Source:** review, section 4.4 and the remarks on knots.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.nominal.defects import segment_errors
from jaxguide.nominal.direct.pseudospectral import Pseudospectral
from jaxguide.nominal.direct.unknowns import Arcwise
from jaxguide.nominal.refinement.arcs import Arcs, arcs, corrected, laid_out, without_collapsed
from jaxguide.problem import Problem
from jaxguide.spectral import legendre_matrix
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import Endless
from jaxguide.types import RESULTS, succeeded

# How strongly breaks follow the error, and the share that smooth segments keep of the worst one's:
# first choices, tried on five problems of the library and not tuned.
_POWER, _FLOOR = 1 / 3, 0.03
_MOST_NODES, _MOST_SEGMENTS = 14, 96
_MOST_MOVES = 6  # of the breaks of one size of mesh
_MOST_JUNCTIONS = 24  # more are chattering, or a singular arc's noise
# Complementarity of a structure, relative to H: up to which it is right, and beyond which wrong.
# Between, an arc is missing or one too many: better than a mesh, but a finer one may tell.
_RIGHT, _WRONG, _ATTEMPTS = 1e-5, 1e-2, 3
_SOUND, _CORRECTIONS = 1e-7, 4  # below it no multiplier asks for another structure
_BEYOND = 1e-6  # how far bounds may be overstepped between nodes
_EXACT = 1e-11  # tolerance of its conditions
_KNOTTED_NODES = 12  # of a segment of the mesh with free knots


class Progress(NamedTuple):
    """One solve of the ladder, for whoever watches."""

    step: str
    extremal: Extremal
    error: float

    def __str__(self) -> str:
        e = self.extremal
        reason = RESULTS[e.result] or "converged"
        return (
            f"{self.step}: {len(e.breaks) - 1} segments of degree {e.degree}, "
            f"objective {float(e.objective):.12g}, defect between nodes {self.error:.1e}, {reason}"
        )


@eqx.filter_jit
def tails(extremal: Extremal) -> Float[Array, ""]:
    """Largest of the last two Legendre coefficients of state and costate, relative to their size:
    by Jackson's theorem what a finer grid could still change."""
    last = legendre_matrix(extremal.reference_nodes)[-2:]
    parts = (extremal.by_segment(extremal.x), extremal.costate_by_segment())
    size = extremal.sizes()
    tails = [
        jnp.max(jnp.abs(jnp.einsum("rp,spk->srk", last, v)) / of[None, None])
        for v, of in zip(parts, (size.x, size.costate), strict=True)
    ]
    return jnp.maximum(*tails)


def moved(
    fractions: Float[np.ndarray, " edge"], errors: Float[np.ndarray, " segment"], segments: int
) -> Float[np.ndarray, " new_edge"]:
    """Breaks of `segments` segments that share the errors more equally."""
    share = np.maximum((errors / errors.max()) ** _POWER, _FLOOR)
    total = np.concatenate([[0.0], np.cumsum(share)])
    new = np.interp(np.linspace(0.0, total[-1], segments + 1), total, fractions)
    new[0], new[-1] = 0.0, 1.0
    return new


def refined(
    run: Callable[[Any, Problem, Any], Extremal],
    method: Pseudospectral,
    problem: Problem,
    extremal: Extremal,
    watch: Callable[[Progress], None],
) -> Extremal:
    """`extremal` again on better meshes, each from the last, until state and costate are resolved
    to `mesh_tolerance`, the refinements are used up, or a solve fails (the last good one is kept).
    `watch` hears of every mesh, and last of why it stopped.

    First the breaks move to where the error is. Then, where controls switch between bounds, the
    junctions become free knots and the controls stay on their bounds between them: exact to
    rounding if that is the structure, and taken only if the certificate's own measures agree. A
    smooth solution gets more nodes; what is left, more segments. The last mesh is solved once more,
    to 1e-11: a barrier at `tolerance` shows in the covectors of bounds nearby.
    """

    def stopped(why: str, last: Extremal) -> Extremal:
        watch(Progress(f"stopped, {why}", last, float(jnp.max(segment_errors(last)))))
        return last

    watch(Progress("first mesh", extremal, float(jnp.max(segment_errors(extremal)))))
    original, mesh, worst, moves, raised, tried = method, method, np.inf, 0, 0, -1
    candidate, doubt = None, np.inf
    while True:
        errors = np.asarray(segment_errors(extremal))
        if not succeeded(extremal.result) or not np.all(np.isfinite(errors)):
            why = "for the solve failed"
            break
        found = arcs(extremal)
        resolved = errors.max() <= method.mesh_tolerance
        smooth = not len(found.junctions) and method.nodes < _MOST_NODES
        # Moving breaks costs no compilation: for as long as it helps.
        move = not (smooth and resolved) and moves < _MOST_MOVES and errors.max() < 0.5 * worst
        if (moves or resolved) and not (move and moves < 2) and tried < min(raised, _ATTEMPTS - 1):
            tried = raised
            exact, wrong = structured(run, original, problem, extremal, found, watch)
            if wrong <= _RIGHT:
                return stopped(f"the structure is clear: {len(found.junctions)} junctions", exact)
            if wrong <= _WRONG and wrong < doubt:
                candidate, doubt = exact, wrong
        if resolved and len(found.junctions):
            why = "states resolved; junctions remain between nodes"
            break
        if resolved and float(tails(extremal)) <= method.mesh_tolerance:
            why = "states and costates resolved"
            break
        fractions = _fractions(extremal)
        segments, nodes = len(fractions) - 1, method.nodes
        if move:
            step, worst, moves = "breaks moved", errors.max(), moves + 1
        elif raised == method.refinements:
            why = f"state or costate short of {method.mesh_tolerance:g} after {raised} refinements"
            break
        else:
            worst, moves, raised = np.inf, 0, raised + 1
            if smooth:
                step, nodes = "more nodes", min(nodes + 4, _MOST_NODES)
            elif 2 * segments <= _MOST_SEGMENTS:
                step, segments = "more segments", 2 * segments
            else:
                why = f"state or costate short of {method.mesh_tolerance:g} on the largest mesh"
                break
        method = _meshed(method, moved(fractions, errors, segments), nodes)
        better = run(method, problem, extremal)
        error = float(jnp.max(segment_errors(better)))
        watch(Progress(step, better, error))
        if not succeeded(better.result):
            why = "for no solution was found on the better mesh; that of the last is kept"
            break
        if error < errors.max() or step != "breaks moved":
            extremal, mesh = better, method
    if candidate is None:
        if succeeded(extremal.result):
            sharper = dataclasses.replace(mesh, starts=1, tolerance=min(mesh.tolerance, _EXACT))
            exact = run(sharper, problem, extremal)
            error, allowed = (float(jnp.max(segment_errors(e))) for e in (exact, extremal))
            # Chattering would use what lies between the nodes.
            if succeeded(exact.result) and error <= max(allowed, method.mesh_tolerance):
                extremal = exact
        return stopped(why, extremal)
    return stopped(f"{why}; the structure found stands, complementarity {doubt:.0e}", candidate)


def _fractions(extremal: Extremal) -> np.ndarray:
    breaks = np.asarray(extremal.breaks)
    return (breaks - breaks[0]) / (breaks[-1] - breaks[0])


def _meshed(
    method: Pseudospectral,
    fractions: np.ndarray,
    nodes: int,
    knots: tuple = (),
    arcwise: Arcwise | None = None,
) -> Pseudospectral:
    changed: dict[str, Any] = {"nodes": nodes, "segments": len(fractions) - 1, "starts": 1}
    return dataclasses.replace(method, fractions=fractions, knots=knots, arcwise=arcwise, **changed)


def structured(
    run: Callable[[Any, Problem, Any], Extremal],
    method: Pseudospectral,
    problem: Problem,
    extremal: Extremal,
    found: Arcs,
    watch: Callable[[Progress], None],
    corrections: int = _CORRECTIONS,
    before: float = _WRONG,
) -> tuple[Extremal, float]:
    """The extremal of the structure `found`, and how wrong that is: its complementarity; infinite
    where it is not clear, not resolved or not feasible. Where multipliers tell what is wrong with
    it, it is corrected by them, for as long as that makes it less wrong than `before`."""
    junctions, switches = found.junctions, found.switches(problem.m)
    clear = 0 < len(junctions) <= _MOST_JUNCTIONS and switches.any()
    if not clear or isinstance(problem, Endless):
        return extremal, np.inf
    breaks, knots, edges, known = laid_out(extremal, found)
    original, asked = method, method.tolerance
    method = dataclasses.replace(method, tolerance=min(asked, _EXACT))
    knotted = _meshed(method, breaks, _KNOTTED_NODES, knots, known)
    exact = run(knotted, problem, extremal)
    if not succeeded(exact.result):
        knotted = dataclasses.replace(knotted, tolerance=asked)
        exact = run(knotted, problem, exact)
    error = float(jnp.max(segment_errors(exact)))
    ends = np.asarray(exact.breaks)[edges]
    again = functools.partial(structured, run, original, problem, exact, watch=watch)
    sound = succeeded(exact.result)
    if sound:
        kept = without_collapsed(found, ends)
        if 0 < len(kept.junctions) < len(junctions):
            watch(Progress("free knots closed arcs", exact, error))
            return again(kept, corrections=corrections, before=before)
    wrong = np.inf
    if sound and error <= method.mesh_tolerance:
        # A wrong structure shows in multipliers of the wrong sign, or bounds left between nodes.
        value = {row["check"]: row["value"] for row in exact.certificate.rows()}
        left = [value[f"{name} bounds"] for name in ("control", "state")]
        if max(*left, value.get("path constraints", 0.0)) <= _BEYOND:
            wrong = value["complementarity"]
    watch(Progress(f"free knots, complementarity {wrong:.0e}", exact, error))
    if corrections and _SOUND < wrong < before:
        better = corrected(exact, found, ends)
        if len(better.junctions) > len(junctions):
            other, less = again(better, corrections=corrections - 1, before=wrong)
            if less < wrong:
                return other, less
    return exact, wrong
