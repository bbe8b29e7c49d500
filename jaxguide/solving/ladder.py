"""Starts of a solve on the host: from the guess, from random ones, up a ladder of grids."""

import dataclasses
from typing import Any

import jax
import numpy as np

from jaxguide.nominal.method import Method
from jaxguide.problem import Problem
from jaxguide.trajectory import Extremal
from jaxguide.types import succeeded

_COARSE = 3  # segments of the mesh that is tried where the first one fails
# How far dynamics may be missed where that one fails, in states per horizon: first choices.
_LOOSENED = (1.0, 0.3, 0.1, 0.03)


def from_starts(method: Method, problem: Problem, guess: Any) -> Extremal:
    """From `guess`; where the method has a mesh, from random starts too, the least objective that
    converged; and where none did, up the ladder of grids."""
    best = method.run(problem, guess)
    if not method.capabilities.mesh:
        return best
    mesh: Any = method
    for k in range(1, mesh.starts):
        other = method.run(problem, jax.random.fold_in(jax.random.key(mesh.seed), k))
        good, better = (succeeded(e.result) for e in (best, other))
        if better and not (good and float(best.objective) <= float(other.objective)):
            best = other
    if not succeeded(best.result) and guess is None and _has_ladder(mesh):
        found = _up_the_ladder(mesh, problem)
        return found if succeeded(found.result) else best
    return best


def _up_the_ladder(method: Any, problem: Problem) -> Extremal:
    """A coarse grid first (review, section 4.4), for fewer nodes ask less of a guess; if that fails
    too, dynamics that may be missed by a delta that shrinks to nothing (review, Theorem 2)."""
    coarse = dataclasses.replace(method, segments=_COARSE)
    below = coarse.run(problem, None)
    if succeeded(below.result):
        return method.run(problem, below)
    units = method.units(problem)
    crossing = np.array([units[name] for name in problem.state_names]) / units["time"]
    guess = None
    for share in _LOOSENED:
        relaxed = dataclasses.replace(coarse, relaxation=share * crossing)
        loose = relaxed.run(problem, guess)
        if not succeeded(loose.result):
            break
        guess = loose
    if guess is None:
        return below
    exact = coarse.run(problem, guess)
    return method.run(problem, exact if succeeded(exact.result) else guess)


def _has_ladder(method: Any) -> bool:
    return bool(method.refinements) and method.fractions is None and method.segments > _COARSE
