"""A solve on the host: from the guess, from random starts, up a ladder of grids, then refined."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxguide.nominal.direct.pseudospectral import RETRIES
from jaxguide.nominal.method import Method, run_on_host
from jaxguide.nominal.refinement.meshes import MeshStep
from jaxguide.nominal.refinement.refine import refined
from jaxguide.problem import Problem
from jaxguide.trajectory import Extremal
from jaxguide.types import succeeded

# Segments of the mesh that is tried where the first one fails, and its most iterations: one that
# needs more leads nowhere. Chosen, not tuned.
_COARSE, _FEW = 3, 200
# How far dynamics may be missed where that one fails, in states per horizon: first choices.
_LOOSENED = (1.0, 0.3, 0.1, 0.03)


def on_meshes(
    method: Method, problem: Problem, guess: Any, watch: Callable[[MeshStep], None] | None
) -> Extremal:
    """Solved from `guess`, from the method's random starts and up the ladder of grids, and refined.
    A method without a mesh solves from `guess` alone."""
    best = _least_of_starts(method, problem, guess)
    if guess is None and not succeeded(best.result) and method.capabilities.mesh:
        best = _up_the_ladder(method, problem, best)
    return refined(method, problem, best, watch) if method.capabilities.mesh else best


def _least_of_starts(method: Any, problem: Problem, guess: Any) -> Extremal:
    """From `guess` and from random starts, the least objective that converged."""
    best = run_on_host(method, problem, guess)
    for k in range(1, method.starts if method.capabilities.mesh else 1):
        other = run_on_host(method, problem, method.key(k))
        good, better = (succeeded(e.result) for e in (best, other))
        if better and not (good and float(best.objective) <= float(other.objective)):
            best = other
    return best


def _up_the_ladder(method: Any, problem: Problem, best: Extremal) -> Extremal:
    """A coarse grid first (review, section 4.4), for fewer nodes ask less of a guess; then random
    starts; then dynamics that may be missed by a delta that shrinks to nothing (review, Theorem 2).
    `best` where all fail."""
    coarse = _coarse(method)
    if coarse is not None:
        below = run_on_host(coarse, problem, None)
        if succeeded(below.result):
            found = run_on_host(method, problem, below)
            if succeeded(found.result):
                return found
    for k in range(method.starts, max(method.starts, RETRIES + 1)):
        found = run_on_host(method, problem, method.key(k))
        if succeeded(found.result):
            return found
    return best if coarse is None else _loosened(method, coarse, problem, best)


def _loosened(method: Any, coarse: Any, problem: Problem, best: Extremal) -> Extremal:
    """The solution from one of the problem with dynamics that may be missed; `best` if there is
    none."""
    units = method.units(problem)
    crossing = np.array([units[name] for name in problem.state_names]) / units["time"]
    guess = None
    for share in _LOOSENED:
        relaxed = dataclasses.replace(coarse, relaxation=share * crossing)
        loose = run_on_host(relaxed, problem, guess)
        if not succeeded(loose.result):
            break
        guess = loose
    if guess is None:
        return best
    exact = run_on_host(coarse, problem, guess)
    found = run_on_host(method, problem, exact if succeeded(exact.result) else guess)
    return found if succeeded(found.result) else best


def _coarse(method: Any) -> Any:
    """The method on a coarse grid; None where its mesh is given, or is as coarse."""
    if method.fractions is not None or method.knots or method.arcwise is not None:
        return None
    few = min(method.max_iterations, _FEW)
    coarse = dataclasses.replace(method, segments=_COARSE, max_iterations=few)
    return coarse if method.segments > _COARSE else None
