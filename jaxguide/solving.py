"""`jg.solve`: from a Problem to a certified Extremal."""

import contextlib
import dataclasses
import functools
import gc
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxguide.certificate import certifier
from jaxguide.nominal.diagnosis import why
from jaxguide.nominal.guesses import check_guess, is_key
from jaxguide.nominal.piecewise_linear import PiecewiseLinear
from jaxguide.nominal.pseudospectral import Pseudospectral, finished
from jaxguide.nominal.refinement import refined
from jaxguide.nominal.shooting import Shooting
from jaxguide.nominal.wrappers import closed, endless, opened
from jaxguide.problem import Problem, is_free, validate, with_array_leaves
from jaxguide.trajectory import Extremal
from jaxguide.types import SolveError, is_traced, require_x64, succeeded

_COARSE = 3  # segments of the mesh that is tried where the first one fails
# How far dynamics may be missed where that one fails, in states per horizon.
_LOOSENED = (1.0, 0.3, 0.1, 0.03)


def solve(
    problem: Problem,
    method: Any = None,
    guess: Any = None,
    throw: bool = True,
    watch: Callable[[Any], None] | None = None,
) -> Extremal:
    """Solves `problem` for an extremal that carries its own certificate.

    **Arguments:**

    - `problem`: the Problem; its parameters may be traced, so this may be `vmap`ped and
      differentiated (implicitly, forward and reverse).
    - `method`: `jg.Shooting`, `jg.Pseudospectral` or `jg.PiecewiseLinear`. Default: shooting, the
      more accurate, unless the Problem has bounds, path constraints or what else shooting cannot
      do; where shooting finds nothing, a direct solution, polished by shooting from there if that
      succeeds. Under a
      trace bounds cannot be seen: name the method, or look for `bounds_violated`.
    - `guess`: None, an Extremal of a similar problem, initial costates (n,) for shooting, or a
      `jax.random.key` for a random start of a direct solve.
    - `watch`: called after each solve of a direct method's refinement with what it is and how
      good, such as `print`. Not under a trace.
    - `throw`: raise if it fails. Under a trace nothing is raised; look at `.result`.

    **Raises:** `ValueError` for a badly stated problem, `RuntimeError` without float64,
    `SolveError` (with what missed, by how much and what to try) when no extremal was found.
    """
    require_x64("jg.solve")
    if method is None and not is_traced((problem, guess)):
        return _by_default(problem, guess, throw, watch)
    method = chosen(problem) if method is None else method
    if isinstance(method, type) or not hasattr(method, "check_fields"):
        raise ValueError(
            f"jg.solve: method is {method!r}; give an instance, such as jg.Pseudospectral()."
        )
    if isinstance(problem, Problem):
        method.check_fields(problem)
    validate(problem)
    method.check(problem)
    direct = isinstance(method, Pseudospectral)
    without_end = direct and is_endless(problem)
    check_guess(problem, guess, direct, without_end or is_traced(problem.final_time))
    problem = with_array_leaves(problem)
    if is_traced((problem, guess, method)):
        return _traced(method, without_end, problem, guess)
    if without_end:
        problem = endless(problem, method.time_scale)
        guess = closed(guess) if _is_opened(guess) else guess
    extremal = _best(method, problem, guess) if direct else _run(method, problem, guess)
    if direct and method.refinements:
        extremal = refined(_run, method, problem, extremal, watch or (lambda _: None))
    if without_end:
        extremal = opened(extremal)
    if throw:
        raise_if_failed(extremal)
    return extremal


def _by_default(problem: Problem, guess: Any, throw: bool, watch: Any) -> Extremal:
    """With the method `chosen`; where shooting finds nothing by itself, from a direct solution."""
    method = Pseudospectral() if is_key(guess) else chosen(problem)
    if not isinstance(method, Shooting):
        return solve(problem, method, guess, throw, watch)
    extremal = solve(problem, method, guess, throw=False)
    if succeeded(extremal.result):
        return extremal
    direct = solve(problem, Pseudospectral(), throw=False, watch=watch)
    if succeeded(direct.result):
        polished = solve(problem, method, direct, throw=False)
        return polished if succeeded(polished.result) else direct
    if throw:
        # The direct method says which constraint is missed, and where; shooting where it got lost.
        raise_if_failed(direct)
    return extremal


def chosen(problem: Problem) -> Any:
    """The method where none is named."""
    return Shooting() if _is_unconstrained(problem) else Pseudospectral()


def on_fixed_mesh(problem: Problem, method: Any) -> Callable[[Problem, Any], Extremal]:
    """What `solve` does under a trace, pure, for problems of this one's structure, which is checked
    here."""
    method.check_fields(problem)
    validate(problem)
    method.check(problem)
    without_end = isinstance(method, Pseudospectral) and is_endless(problem)
    return jax.tree_util.Partial(_traced, method, without_end)


@eqx.filter_jit  # else a bare jax.grad runs it operation by operation
def _traced(method: Any, without_end: bool, problem: Problem, guess: Any) -> Extremal:
    if without_end:
        problem = endless(problem, method.time_scale)
        guess = closed(guess) if _is_opened(guess) else guess
    extremal = method(problem, guess, certifier(method.accuracy))
    return opened(extremal) if without_end else extremal


def _is_opened(guess: Any) -> bool:
    return isinstance(guess, Extremal) and guess.stretch is not None


def is_endless(problem: Problem) -> bool:
    """Whether its final time is infinite, as far as can be seen."""
    tf = problem.final_time
    return not is_free(tf) and not is_traced(tf) and bool(np.any(np.isinf(np.asarray(tf))))


def _is_unconstrained(problem: Problem) -> bool:
    """Whether nothing but equalities at the ends restricts the solution: shooting's case."""
    if not isinstance(problem, Problem) or is_traced(
        (problem.state_bounds, problem.control_bounds)
    ):
        return True
    infinite = lambda bounds: all(np.all(np.isinf(np.asarray(b))) for b in bounds)
    own = type(problem)
    return (
        infinite(problem.state_bounds)
        and infinite(problem.control_bounds)
        and own.path_constraints is Problem.path_constraints
        and own.integrands is Problem.integrands
        and not problem.parameter_paths()
        and not is_endless(problem)
        and bool(np.all(np.asarray(problem.endpoint_bounds[0]) == problem.endpoint_bounds[1]))
    )


@functools.cache
def quick_compilation() -> dict[str, bool]:
    """Options that halve the time it takes to compile a direct solve, for a fifth of its speed;
    none where this XLA does not know them."""
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(1.0).compile()
    except Exception:  # whatever the backend says of options it does not know
        return {}
    return options


def _best(method: Pseudospectral, problem: Problem, guess: Any) -> Extremal:
    """From `guess` and from random starts, the least objective that converged."""
    best = _run(method, problem, guess)
    for k in range(1, method.starts):
        other = _run(method, problem, jax.random.fold_in(jax.random.key(method.seed), k))
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
    below = _run(coarse, problem, None)
    if succeeded(below.result):
        return _run(method, problem, below)
    units = method.units(problem)
    crossing = np.array([units[name] for name in problem.state_names]) / units["time"]
    guess = None
    for share in _LOOSENED:
        loose = _run(dataclasses.replace(coarse, relaxation=share * crossing), problem, guess)
        if not succeeded(loose.result):
            break
        guess = loose
    if guess is None:
        return below
    exact = _run(coarse, problem, guess)
    return _run(method, problem, exact if succeeded(exact.result) else guess)


def _has_ladder(method: Pseudospectral) -> bool:
    return bool(method.refinements) and method.fractions is None and method.segments > _COARSE


def _run(method: Any, problem: Problem, guess: Any) -> Extremal:
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
    with _without_collection():
        return run(problem, *_prepared(method, problem, guess), certifier(method.accuracy))


@contextlib.contextmanager
def _without_collection() -> Iterator[None]:
    """Python's cyclic collector waits: it frees nothing of a program being traced, and took a
    sixth of the time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def called(method: Any, problem: Problem, guess: Any) -> Extremal:
    return method(problem, guess, certifier(method.accuracy))


_whole = eqx.filter_jit(called)


@eqx.filter_jit
def _prepared(method: Pseudospectral, problem: Problem, guess: Any) -> Any:
    return method.prepared(problem, guess)


@functools.cache
def compiled(function: Callable[..., Any], quick: bool) -> Callable[..., Any]:
    """`function` jitted, once for each way to compile it."""
    options: Any = {"compiler_options": (quick and quick_compilation()) or None}
    return eqx.filter_jit(function, **options)


def raise_if_failed(extremal: Extremal) -> None:
    """Raises `SolveError` unless `extremal.result` is success, naming the worst miss. Host only."""
    if not succeeded(extremal.result):
        raise SolveError(why(extremal))
