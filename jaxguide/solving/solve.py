"""`jg.solve`: from a Problem to a certified Extremal."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np

from jaxguide.arrays import on_device
from jaxguide.certificate import Certified, certified
from jaxguide.host.lapack import one_thread
from jaxguide.host.progress import spoken
from jaxguide.nominal.direct.pseudospectral import Pseudospectral
from jaxguide.nominal.method import Method, called
from jaxguide.nominal.refinement.ladder import on_meshes
from jaxguide.problem import Problem
from jaxguide.solving.diagnosis import shortfall, why
from jaxguide.solving.given import Given, default_method, given
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import opened
from jaxguide.types import SolveError, SolveWarning, require_x64, succeeded, usable


def solve(
    problem: Problem,
    method: Any = None,
    guess: Any = None,
    throw: bool = True,
    watch: Callable[[Any], None] | None = None,
    progress: bool = True,
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
    - `progress`: from two seconds on say on stderr which mesh is being solved, where that is a
      terminal or a notebook.
    - `throw`: raise if it fails, and warn (`jg.SolveWarning`) if the solution is not resolved to
      the method's `mesh_tolerance`. Under a trace neither; look at `.result`.

    **Raises:** `ValueError` for a badly stated problem, `RuntimeError` without float64,
    `SolveError` (with the worst constraint, by how much it is missed and what to try) when no
    extremal was found.
    """
    require_x64("jg.solve")
    by = default_method(problem, guess) if method is None else method
    start = given(problem, by, guess)
    if start.traced:
        extremal = on_fixed_mesh(by, start.problem, start.guess)
    else:
        otherwise, label = Pseudospectral() if method is None else None, type(problem).__name__
        with np.errstate(all="ignore"), one_thread(), spoken(label, progress) as say:
            by, extremal = _found(start, _both(watch, say), otherwise)
        extremal = on_device(extremal)
    extremal = opened(extremal)
    done = certified(extremal, by.accuracy)
    if throw and not start.traced:
        raise_if_failed(extremal)
        if not succeeded(extremal.result):
            warnings.warn(shortfall(done), SolveWarning, stacklevel=2)
    return done


def _both(watch: Callable[[Any], None] | None, say: Callable[[str], None]) -> Callable[[Any], None]:
    """A mesh is told to `watch`, if there is one, and said."""

    def hear(step: Any) -> None:
        say(str(step))
        if watch is not None:
            watch(step)

    return hear


# The solve under a trace, pure; compiled whole, because a bare `jax.grad` would run it operation by
# operation.
on_fixed_mesh = eqx.filter_jit(called)


def _found(start: Given, watch: Any, otherwise: Method | None) -> tuple[Method, Extremal]:
    """The extremal, sought on the host, and the method that found it.

    `otherwise`: a direct method to start from where an indirect one finds nothing by itself. Where
    both fail its extremal is returned: it says which constraint is missed, and where.
    """
    method, problem, guess = start.method, start.problem, start.guess
    fallback = None if method.capabilities.direct else otherwise
    if fallback is not None:
        extremal = method.run(problem, guess)
        if succeeded(extremal.result):
            return method, extremal
        method, guess = fallback, None
    extremal = on_meshes(method, problem, guess, watch)
    if fallback is not None and usable(extremal.result):
        polished = start.method.run(problem, extremal)
        if succeeded(polished.result):
            return start.method, polished
    return method, extremal


def raise_if_failed(extremal: Extremal) -> None:
    """Raises `SolveError` unless there is a solution, naming the worst miss. Host only."""
    if not usable(extremal.result):
        raise SolveError(why(extremal))
