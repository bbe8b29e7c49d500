"""`jg.solve`: from a Problem to a certified Extremal."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxguide.certificate import certify
from jaxguide.nominal.shooting import Shooting
from jaxguide.problem import Problem, validate, with_array_leaves
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS, SolveError, is_traced, require_x64


def solve(problem: Problem, method: Any = None, guess: Any = None, throw: bool = True) -> Extremal:
    """Solves `problem` for an extremal that carries its own certificate.

    **Arguments:**

    - `problem`: the Problem; its parameters may be traced, so this may be `vmap`ped and
      differentiated (implicitly, forward and reverse).
    - `method`: default the most accurate available, multi-start multiple shooting.
    - `guess`: None, an Extremal of a similar problem, or initial costates (n,).
    - `throw`: raise if it fails. Under a trace nothing is raised; look at `.result`.

    **Raises:** `ValueError` for a badly stated problem, `RuntimeError` without float64,
    `SolveError` (with what missed, by how much and what to try) when no extremal was found.
    """
    require_x64("jg.solve")
    method = Shooting() if method is None else method
    if isinstance(problem, Problem):
        method.check_fields(problem)
    validate(problem)
    method.check(problem)
    problem = with_array_leaves(problem)
    if is_traced((problem, guess)):
        return method(problem, guess, certify)
    extremal = _run(method, problem, guess)
    if throw:
        raise_if_failed(extremal)
    return extremal


@eqx.filter_jit
def _run(method: Any, problem: Problem, guess: Any) -> Extremal:
    return method(problem, guess, certify)


def raise_if_failed(extremal: Extremal) -> None:
    """Raises `SolveError` unless `extremal.result` is success, naming the worst miss. Host only."""
    if bool(extremal.result == RESULTS.successful):
        return
    problem = extremal.problem
    message = [f"{type(problem).__name__}: {RESULTS[extremal.result]}"]
    e = np.asarray(
        problem.endpoint_constraints(extremal.x[0], extremal.x[-1], extremal.t[0], extremal.t[-1])
    )
    lo, hi = (np.broadcast_to(np.asarray(b, float), e.shape) for b in problem.endpoint_bounds)
    miss = np.maximum(lo - e, 0) + np.maximum(e - hi, 0)
    if not np.all(np.isfinite(np.asarray(extremal.x))):
        message.append("The last iterate left finite numbers.")
    elif miss.size and miss.max() > 1e-8:
        i = int(np.argmax(miss))
        message.append(
            f"Endpoint constraint {i} misses its bounds by {miss[i]:.3g} "
            f"(value {e[i]:.6g}, bounds [{lo[i]:g}, {hi[i]:g}]); if it contradicts another or lies "
            "out of reach, relax it."
        )
    message.append(f"Boundary residual {float(jnp.asarray(extremal.residual)):.2e}.")
    raise SolveError(" ".join(message))
