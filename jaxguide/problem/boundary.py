"""Boundary data of a Problem as arrays: initial states, their bounds, a control to start from."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.bounds import bounds_of
from jaxguide.problem.statement import Free, Problem, is_free, start_value
from jaxguide.types import is_traced


def is_endless(problem: Problem) -> bool:
    """Whether its final time is infinite; False where that is traced."""
    tf = problem.final_time
    return not is_free(tf) and not is_traced(tf) and bool(np.any(np.isinf(np.asarray(tf))))


def initially_free(problem: Problem) -> tuple[bool, ...]:
    """Which components of the initial state are free."""
    entries = problem.initial_state
    if isinstance(entries, (tuple, list)):
        return tuple(is_free(e) for e in entries)
    return (entries is None or is_free(entries),) * problem.n


def initial_entries(problem: Problem) -> tuple[Any, ...]:
    """One entry a state: a number or `Free`."""
    start = problem.initial_state
    if isinstance(start, (tuple, list)):
        return tuple(start)
    if start is None or is_free(start):
        return (Free() if start is None else start,) * problem.n
    return tuple(start[i] for i in range(problem.n))


def initial_values(problem: Problem, dtype: Any) -> Float[Array, " n"]:
    """The initial state, free components where the search for them starts (`start_value`)."""
    entries = problem.initial_state
    if entries is None:
        return xp.zeros(problem.n, dtype)
    if isinstance(entries, (tuple, list)):
        return xp.stack([xp.asarray(start_value(e), dtype) for e in entries])
    return xp.broadcast_to(xp.asarray(start_value(entries), dtype), (problem.n,))


def initial_bounds(problem: Problem) -> tuple[Array, Array]:
    """(lower, upper) of the initial state, (n,) each: the state bounds, narrowed by the limits of
    components that are `Free`."""
    lo, hi = bounds_of(problem.state_bounds, problem.n, jnp.result_type(float))
    entries = [e if is_free(e) else Free() for e in initial_entries(problem)]
    own = [xp.stack([xp.asarray(getattr(e, k), lo.dtype) for e in entries]) for k in ("lo", "hi")]
    return xp.maximum(lo, own[0]), xp.minimum(hi, own[1])


def start_control(problem: Problem, dtype: Any) -> Float[Array, " m"]:
    """A control to start Newton's method from: near the middle of finite bounds, otherwise near the
    admissible control closest to 0.

    Near, and not at: a tenth of half the width (or 0.1) keeps clear of points where H_u = 0 by
    symmetry, which may be maxima. Chosen, not tuned.
    """
    lo, hi = bounds_of(problem.control_bounds, problem.m, dtype)
    finite = xp.isfinite(lo) & xp.isfinite(hi)
    low, high = xp.where(finite, lo, -1.0), xp.where(finite, hi, 1.0)
    middle = xp.where(finite, (low + high) / 2, xp.clip(xp.zeros_like(lo), lo, hi))
    return middle + 0.1 * (high - low) / 2
