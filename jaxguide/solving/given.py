"""The input of a solve: problem, method and guess, checked and on a finite horizon."""

from typing import Any, NamedTuple

import numpy as np

from jaxguide.certificate import uncertified
from jaxguide.nominal.direct.pseudospectral import Pseudospectral
from jaxguide.nominal.guesses import check_guess, is_key
from jaxguide.nominal.indirect.shooting import Shooting
from jaxguide.nominal.method import Method, refuse_beyond
from jaxguide.problem import Problem, is_endless, validate, with_typed_leaves
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import made_finite
from jaxguide.types import is_traced


class Given(NamedTuple):
    """A problem, a method that can do it, and a guess that the method can start from."""

    problem: Problem
    method: Method
    guess: Any
    traced: bool  # whether any number in them is: then nothing is refined and nothing raised


def given(problem: Problem, method: Any, guess: Any) -> Given:
    """The input of `method` for `problem` and `guess`, once both are checked.

    **Raises:** `ValueError`.
    """
    if not isinstance(method, Method):
        raise ValueError(
            f"jg.solve: method is {method!r}; give an instance, such as jg.Pseudospectral()."
        )
    validate(problem)
    refuse_beyond(method, problem)
    method.check(problem)
    check_guess(problem, guess, method)
    traced = is_traced((problem, guess, method))
    guess = uncertified(guess) if isinstance(guess, Extremal) else guess
    stated = with_typed_leaves(problem)
    if is_endless(problem):
        able: Any = method  # its capabilities say that it has a time scale
        stated, guess = made_finite(stated, guess, able.time_scale)
    return Given(stated, method, guess, traced)


def default_method(problem: Problem, guess: Any = None) -> Method:
    """The method where none is named."""
    direct = is_key(guess) or not _is_unconstrained(problem)
    return Pseudospectral() if direct else Shooting()


def _is_unconstrained(problem: Problem) -> bool:
    """Whether nothing but equalities at the ends restricts the solution: shooting's case."""
    if not isinstance(problem, Problem) or is_traced(
        (problem.state_bounds, problem.control_bounds)
    ):
        return True
    infinite = lambda bounds: all(np.all(np.isinf(np.asarray(b))) for b in bounds)
    own = type(problem)
    return (
        problem.m > 0
        and infinite(problem.state_bounds)
        and infinite(problem.control_bounds)
        and own.path_constraints is Problem.path_constraints
        and own.integrands is Problem.integrands
        and not problem.parameter_paths()
        and not is_endless(problem)
        and bool(np.all(np.asarray(problem.endpoint_bounds[0]) == problem.endpoint_bounds[1]))
    )
