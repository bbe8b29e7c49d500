"""`jg.solve`: from a Problem to a certified Extremal."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np

from jaxguide.arrays import on_device
from jaxguide.certificate import Certified, certified, certify
from jaxguide.host.lapack import one_thread
from jaxguide.host.progress import spoken
from jaxguide.nominal.direct.pseudospectral import Pseudospectral
from jaxguide.nominal.direct.stationary import with_stationary_controls
from jaxguide.nominal.method import Method, called
from jaxguide.nominal.refinement.ladder import on_meshes
from jaxguide.problem import Problem
from jaxguide.solving.diagnosis import shortfall, why
from jaxguide.solving.given import Given, default_method, given
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import opened
from jaxguide.types import SolveError, SolveWarning, require_x64, succeeded, usable

# Defect between nodes of a direct solution that is to be as accurate as shooting: a tenth of what
# shooting's certificates allow. Chosen, not tuned.
_TIGHT = 1e-10


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
      own. Default: `jg.Pseudospectral()`; if the Problem has no bounds, path constraints or
      anything else that shooting cannot do, on a mesh fine enough for shooting's accuracy, 1e-9 of
      every row of the certificate, and polished by shooting where no mesh is. Under a trace:
      shooting for any problem whose bounds cannot be seen; name the method, or look for
      `bounds_violated`.
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
        label = type(problem).__name__
        with np.errstate(all="ignore"), one_thread(), spoken(label, progress) as say:
            by, extremal = _found(start, _both(watch, say), method is None)
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


def _found(start: Given, watch: Any, by_default: bool) -> tuple[Method, Extremal]:
    """The extremal, sought on the host, and the method that found it, or is as accurate.

    By default a problem for shooting is solved directly first, which compiles in a second what
    shooting compiles in ten: that is the solution if it is as good as shooting's would be; if not,
    shooting starts from there, and if there is none, from its own starts. Where both fail the
    direct extremal is returned: it says which constraint is missed, and where.
    """
    method, problem, guess = start.method, start.problem, start.guess
    if method.capabilities.direct or not by_default:
        return method, on_meshes(method, problem, guess, watch)
    of_its_own = guess is not None and not isinstance(guess, Extremal)  # costates
    if of_its_own:
        extremal = method.run(problem, guess)
        if succeeded(extremal.result):
            return method, extremal
    direct = Pseudospectral(mesh_tolerance=_TIGHT)
    extremal = on_meshes(direct, problem, None if of_its_own else guess, watch)
    if succeeded(extremal.result):
        extremal = with_stationary_controls(extremal)
        if np.all(certify(extremal, tolerance=method.accuracy).passed):
            return method, extremal
    near = extremal if usable(extremal.result) else guess
    polished = method.run(problem, None if of_its_own and near is guess else near)
    if succeeded(polished.result):
        return method, polished
    return direct, extremal


def raise_if_failed(extremal: Extremal) -> None:
    """Raises `SolveError` unless there is a solution, naming the worst miss. Host only."""
    if not usable(extremal.result):
        raise SolveError(why(extremal))
