"""`jg.solve`: from a Problem to a certified Extremal."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np

from jaxguide.certificate import Certified, certified, uncertified
from jaxguide.nominal.direct.pseudospectral import Pseudospectral
from jaxguide.nominal.guesses import check_guess, is_key
from jaxguide.nominal.indirect.shooting import Shooting
from jaxguide.nominal.method import Method, refuse_beyond
from jaxguide.nominal.refinement.refine import refined
from jaxguide.problem import Problem, validate, with_array_leaves
from jaxguide.solving.diagnosis import why
from jaxguide.solving.ladder import from_starts
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import is_endless, made_finite, opened
from jaxguide.types import SolveError, is_traced, require_x64, succeeded


def solve(
    problem: Problem,
    method: Any = None,
    guess: Any = None,
    throw: bool = True,
    watch: Callable[[Any], None] | None = None,
) -> Certified:
    """Solves `problem` for an extremal that carries its own certificate.

    **Arguments:**

    - `problem`: the Problem; its parameters may be traced, so this may be `vmap`ped and
      differentiated (implicitly, forward and reverse).
    - `method`: `jg.Shooting`, `jg.Pseudospectral`, `jg.PiecewiseLinear` or a `jg.Method` of your
      own. Default: shooting, the more accurate, unless the Problem has bounds, path constraints or
      anything else that shooting cannot do; if shooting finds nothing, a direct solution, polished
      by shooting from there if that succeeds. Under a trace bounds cannot be seen: name the
      method, or look for `bounds_violated`.
    - `guess`: None, an Extremal of a similar problem, initial costates (n,) for shooting, or a
      `jax.random.key` for a random start of a direct solve.
    - `watch`: called after each solve of a direct method's refinement with what it is and how
      good, such as `print`. Not under a trace.
    - `throw`: raise if it fails. Under a trace nothing is raised; look at `.result`.

    **Raises:** `ValueError` for a badly stated problem, `RuntimeError` without float64,
    `SolveError` (with the worst constraint, by how much it is missed and what to try) when no
    extremal was found.
    """
    require_x64("jg.solve")
    if method is None and not is_traced((problem, guess)):
        return _by_default(problem, guess, throw, watch)
    method = default_method(problem) if method is None else method
    problem, guess, without_end = stated(problem, method, guess)
    if is_traced((problem, guess, method)):
        return certified(on_fixed_mesh(method, without_end, problem, guess), method.accuracy)
    extremal = _on_host(method, without_end, problem, guess, watch)
    if throw:
        raise_if_failed(extremal)
    return certified(extremal, method.accuracy)


def _by_default(problem: Problem, guess: Any, throw: bool, watch: Any) -> Certified:
    """With the default method; where shooting finds nothing by itself, from a direct solution."""
    method = Pseudospectral() if is_key(guess) else default_method(problem)
    if method.capabilities.direct:
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


def default_method(problem: Problem) -> Method:
    """The method where none is named."""
    return Shooting() if _is_unconstrained(problem) else Pseudospectral()


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


def stated(problem: Problem, method: Any, guess: Any) -> tuple[Problem, Any, bool]:
    """Problem and guess as a method takes them, once nothing is wrong with either; and whether the
    horizon has no end.

    **Raises:** `ValueError`.
    """
    if not isinstance(method, Method):
        raise ValueError(
            f"jg.solve: method is {method!r}; give an instance, such as jg.Pseudospectral()."
        )
    validate(problem)
    refuse_beyond(method, problem)
    method.check(problem)
    without_end = is_endless(problem)
    maybe = without_end or is_traced(problem.final_time)
    check_guess(problem, guess, method, method.capabilities.endless and maybe)
    guess = uncertified(guess) if isinstance(guess, Extremal) else guess
    return with_array_leaves(problem), guess, without_end


def _on_host(
    method: Method, without_end: bool, problem: Problem, guess: Any, watch: Any
) -> Extremal:
    """Starts and refinement, each solve a compiled program."""
    if without_end:
        problem, guess = made_finite(problem, guess, method)
    extremal = from_starts(method, problem, guess)
    if method.capabilities.mesh:
        extremal = refined(method, problem, extremal, watch)
    return opened(extremal) if without_end else extremal


@eqx.filter_jit  # else a bare jax.grad runs it operation by operation
def on_fixed_mesh(method: Method, without_end: bool, problem: Problem, guess: Any) -> Extremal:
    """What `solve` does under a trace: pure, for a problem that has been `stated`."""
    if without_end:
        problem, guess = made_finite(problem, guess, method)
    extremal = method(problem, guess)
    return opened(extremal) if without_end else extremal


def raise_if_failed(extremal: Extremal) -> None:
    """Raises `SolveError` unless `extremal.result` is success, naming the worst miss. Host only."""
    if not succeeded(extremal.result):
        raise SolveError(why(extremal))
