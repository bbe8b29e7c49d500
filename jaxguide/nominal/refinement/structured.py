"""The extremal of a structure: arcs between free knots, each control on its bound or smooth.

**Source:** review, section 4.4 and the remarks on knots.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxguide.nominal.defects import segment_errors
from jaxguide.nominal.method import run_on_host
from jaxguide.nominal.refinement.arcs import Arcs, corrected, without_collapsed
from jaxguide.nominal.refinement.layout import laid_out
from jaxguide.nominal.refinement.meshes import MeshStep, remeshed
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
_BEYOND = 1e-6  # by how much, of its size, a bound may be overstepped between nodes
EXACT = 1e-11  # tolerance of the first-order conditions, so that the barrier does not show
_NODES = 12  # of a segment of the mesh with free knots: a first choice, tried on ten problems


def structured(
    method: Any,
    problem: Problem,
    extremal: Extremal,
    found: Arcs,
    watch: Callable[[MeshStep], None],
    corrections: int = _CORRECTIONS,
    before: float = WRONG,
) -> tuple[Extremal, float]:
    """The extremal of the structure `found`, and how wrong that structure is: its complementarity,
    infinite where the structure is not clear, not resolved or not feasible.

    Arcs that the free knots close are dropped. Where multipliers of the wrong sign show which arc
    is wrong, the structure is corrected by them, as long as that makes it less wrong than `before`.
    """
    junctions, switches = found.junctions, found.switches(problem.m)
    clear = 0 < len(junctions) <= _MOST_JUNCTIONS and switches.any()
    if not clear or isinstance(problem, Endless):
        return extremal, np.inf
    exact, edges = _solved(method, problem, extremal, found)
    error = float(np.max(segment_errors(exact)))
    ends = np.asarray(exact.breaks)[edges]
    again = functools.partial(structured, method, problem, exact, watch=watch)
    sound = succeeded(exact.result)
    if sound:
        kept = without_collapsed(found, ends)
        if 0 < len(kept.junctions) < len(junctions):
            watch(MeshStep("free knots closed arcs", exact, error))
            return again(kept, corrections=corrections, before=before)
    wrong = _wrongness(exact) if sound and error <= method.mesh_tolerance else np.inf
    watch(MeshStep(f"free knots, complementarity {wrong:.0e}", exact, error))
    if corrections and _SOUND < wrong < before:
        better = corrected(exact, found, ends)
        if len(better.junctions) > len(junctions):
            other, less = again(better, corrections=corrections - 1, before=wrong)
            if less < wrong:
                return other, less
    return exact, wrong


def _solved(
    method: Any, problem: Problem, extremal: Extremal, found: Arcs
) -> tuple[Extremal, np.ndarray]:
    """The solution on the mesh of `found`, to EXACT if that converges, and the breaks at which its
    arcs end."""
    mesh = laid_out(extremal, found)
    asked = method.tolerance
    sharp = dataclasses.replace(method, tolerance=min(asked, EXACT))
    knotted = remeshed(sharp, mesh.fractions, _NODES, mesh.knots, mesh.arcwise)
    exact = run_on_host(knotted, problem, extremal)
    if not succeeded(exact.result):
        exact = run_on_host(dataclasses.replace(knotted, tolerance=asked), problem, exact)
    return exact, mesh.edges


def _wrongness(exact: Extremal) -> float:
    """Its complementarity; infinite where a bound is overstepped between nodes."""
    over, complementarity = (float(v) for v in worst_bound_errors(exact))
    return complementarity if over <= _BEYOND else np.inf
