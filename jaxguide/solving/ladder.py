"""Starts of a solve on the host: from the guess, from random ones, up a ladder of grids."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxguide.certificate import certifier
from jaxguide.host.compilation import compiled, without_collection
from jaxguide.nominal.direct.pseudospectral import Pseudospectral, finished
from jaxguide.nominal.indirect.shooting import Shooting
from jaxguide.nominal.parametric.piecewise_linear import PiecewiseLinear
from jaxguide.problem import Problem
from jaxguide.trajectory import Extremal
from jaxguide.types import succeeded

_COARSE = 3  # segments of the mesh that is tried where the first one fails
# How far dynamics may be missed where that one fails, in states per horizon.
_LOOSENED = (1.0, 0.3, 0.1, 0.03)


def best_start(method: Pseudospectral, problem: Problem, guess: Any) -> Extremal:
    """From `guess` and from random starts, the least objective that converged."""
    best = run_once(method, problem, guess)
    for k in range(1, method.starts):
        other = run_once(method, problem, jax.random.fold_in(jax.random.key(method.seed), k))
        good, better = (succeeded(e.result) for e in (best, other))
        if better and not (good and float(best.objective) <= float(other.objective)):
            best = other
    if not succeeded(best.result) and guess is None and _has_ladder(method):
        found = _from_below(method, problem)
        return found if succeeded(found.result) else best
    return best


def _from_below(method: Pseudospectral, problem: Problem) -> Extremal:
    """Up the ladder of grids (review, section 4.4): fewer nodes ask less of a guess, and dynamics
    that may be missed by delta, in the end by nothing, less still (Theorem 2)."""
    coarse = dataclasses.replace(method, segments=_COARSE)
    below = run_once(coarse, problem, None)
    if succeeded(below.result):
        return run_once(method, problem, below)
    units = method.units(problem)
    crossing = np.array([units[name] for name in problem.state_names]) / units["time"]
    guess = None
    for share in _LOOSENED:
        loose = run_once(dataclasses.replace(coarse, relaxation=share * crossing), problem, guess)
        if not succeeded(loose.result):
            break
        guess = loose
    if guess is None:
        return below
    exact = run_once(coarse, problem, guess)
    return run_once(method, problem, exact if succeeded(exact.result) else guess)


def _has_ladder(method: Pseudospectral) -> bool:
    return bool(method.refinements) and method.fractions is None and method.segments > _COARSE


def run_once(method: Any, problem: Problem, guess: Any) -> Extremal:
    if isinstance(method, Shooting):
        return _whole(method, problem, guess)
    if isinstance(method, PiecewiseLinear):
        return compiled(called, True)(method, problem, guess)
    # In two programs, so that the optimiser's serves every guess and every mesh of its size.
    if method.log:
        print(
            "designer units: "
            + ", ".join(f"{k} {v:.4g}" for k, v in method.units(problem, guess).items())
        )
    run = compiled(finished, method.quick)
    with without_collection():
        return run(problem, *_prepared(method, problem, guess), certifier(method.accuracy))


def called(method: Any, problem: Problem, guess: Any) -> Extremal:
    return method(problem, guess, certifier(method.accuracy))


_whole = eqx.filter_jit(called)


@eqx.filter_jit
def _prepared(method: Pseudospectral, problem: Problem, guess: Any) -> Any:
    return method.prepared(problem, guess)
