"""`jg.solve`: from a Problem to a certified Extremal."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxguide.certificate import certifier
from jaxguide.nominal.direct.pseudospectral import Pseudospectral
from jaxguide.nominal.guesses import check_guess, is_key
from jaxguide.nominal.indirect.shooting import Shooting
from jaxguide.nominal.refinement.refine import refined
from jaxguide.problem import Problem, validate, with_array_leaves
from jaxguide.solving.diagnosis import why
from jaxguide.solving.ladder import best_start, run_once
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import closed, endless, is_endless, opened
from jaxguide.types import SolveError, is_traced, require_x64, succeeded


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
    extremal = best_start(method, problem, guess) if direct else run_once(method, problem, guess)
    if direct and method.refinements:
        extremal = refined(run_once, method, problem, extremal, watch or (lambda _: None))
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


def raise_if_failed(extremal: Extremal) -> None:
    """Raises `SolveError` unless `extremal.result` is success, naming the worst miss. Host only."""
    if not succeeded(extremal.result):
        raise SolveError(why(extremal))
