"""Bounds and path constraints at an end that other conditions there settle already.

Where the endpoint constraints fix a state at its bound, bound and constraint have the same
gradient, and their multipliers are any two numbers of the right sum. The bound is left out there.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxguide.bounds import bounds_of
from jaxguide.linalg import gauss_solve
from jaxguide.nominal.ends import horizon_guess, nearest_ends
from jaxguide.problem import (
    Problem,
    count,
    endpoint_count,
    initial_values,
    initially_free,
    is_free,
    parameters,
    start_control,
)
from jaxguide.types import is_traced

# Shares of a gradient that are nothing, and of a size by which a value may lie outside its bounds
# and still meet them: both well above rounding and below what is meant to differ.
_NOTHING = 1e-6
_RIDGE = 1e-12  # keeps redundant endpoint constraints solvable: far below `_NOTHING`


class Implied(NamedTuple):
    """Which state bounds hold at the end because of the endpoint constraints, and which path
    constraints do there and at the start."""

    state: Bool[Array, " n"]
    first: Bool[Array, " p"]
    last: Bool[Array, " p"]


def may_be_implied(problem: Problem) -> bool:
    """Whether there is any bound to be implied: by shapes, and by numbers where they are known."""
    if parameters(problem):
        return False
    unbounded = not is_traced(problem.state_bounds) and all(
        bool(np.all(np.isinf(np.asarray(b)))) for b in problem.state_bounds
    )
    return bool(count(problem, "path_constraints")) or not unbounded


@jax.jit
def implied_at_ends(problem: Problem) -> Implied:
    """The bounds that are implied: those of states that the linear ones of the endpoint constraints
    determine, and those of path constraints that depend on such states alone; each only where it is
    met. What nothing but a nonlinear constraint determines is left to the optimiser."""
    problem = jax.tree_util.tree_map(jax.lax.stop_gradient, problem)
    dtype, n = jnp.result_type(float), problem.n
    t0, tf = horizon_guess(problem)
    x0, xf = nearest_ends(problem, t0, tf)
    known = ~jnp.asarray(initially_free(problem))
    lo, hi = bounds_of(problem.state_bounds, n, dtype)
    unit = 1 + jnp.maximum(jnp.abs(x0), jnp.abs(xf))
    rows = _settling_rows(problem, x0, xf, t0, tf, unit)
    gram = rows @ rows.T + _RIDGE * jnp.eye(rows.shape[0], dtype=dtype)
    # The projection onto what the constraints determine.
    onto = rows.T @ gauss_solve(gram, rows) if rows.shape[0] else jnp.zeros((n, n), dtype)
    met = (xf >= lo - _NOTHING * unit) & (xf <= hi + _NOTHING * unit)
    state = (jnp.diag(onto) >= 1 - _NOTHING) & met
    start = jnp.where(known, initial_values(problem, dtype), x0)
    given = jnp.diag(jnp.where(known, 1.0, 0.0).astype(dtype))
    first = _path_implied(problem, t0, start, given, unit, not is_free(problem.initial_time))
    last = _path_implied(problem, tf, xf, onto, unit, not is_free(problem.final_time))
    return Implied(state, first, last)


def _settling_rows(
    problem: Problem, x0: Array, xf: Array, t0: Array, tf: Array, unit: Array
) -> Array:
    """Gradients by the final state, in its units, of the endpoint equations that are linear and in
    which nothing else is unknown; zero for the others. Rows have the length 1."""
    dtype, q = x0.dtype, endpoint_count(problem)
    if not q:
        return jnp.zeros((0, problem.n), dtype)
    free = jnp.asarray(initially_free(problem))
    clocks = jnp.array([is_free(problem.initial_time), is_free(problem.final_time)])
    e = lambda x0, xf, t: problem.endpoint_constraints(x0, xf, t[0], t[1])
    slopes = jax.jacfwd(e, argnums=(0, 1, 2))
    times = jnp.stack([t0, tf])
    here, there = slopes(x0, xf, times), slopes(x0 + unit, xf + unit, times + (tf - t0))
    by = here[1] * unit[None]
    length = jnp.linalg.norm(by, axis=1)
    small = _NOTHING * length
    others = jnp.max(jnp.where(free[None], jnp.abs(here[0]) * unit[None], 0.0), axis=1)
    clock = jnp.max(jnp.where(clocks[None], jnp.abs(here[2]), 0.0), axis=1) * (tf - t0)
    bent = jnp.max(jnp.abs(there[1] * unit[None] - by), axis=1)
    lo, hi = bounds_of(problem.endpoint_bounds, q, dtype)
    miss = jnp.abs(e(x0, xf, times) - lo)
    fine = (lo == hi) & (length > 0) & (miss <= small)
    fine = fine & (others <= small) & (clock <= small) & (bent <= small)
    return jnp.where(fine[:, None], by / jnp.where(length > 0, length, 1.0)[:, None], 0.0)


def _path_implied(
    problem: Problem, t: Array, x: Array, onto: Array, unit: Array, timed: bool
) -> Bool[Array, " p"]:
    """Path constraints whose gradient lies in the space that `onto` projects on, which depend on no
    control (nor on a time that is not `timed`), and which are met at `x`."""
    dtype, p = x.dtype, count(problem, "path_constraints")
    if not p:
        return jnp.zeros(0, bool)
    u = start_control(problem, dtype)
    slopes = jax.jacfwd(problem.path_constraints, argnums=(0, 1, 2))
    by_t, by_x, by_u = slopes(t, x, u)
    _, _, also = slopes(t, x, u + 1)
    by_x = by_x * unit[None]
    length = jnp.linalg.norm(by_x, axis=1)
    small = _NOTHING * length
    steered = jnp.maximum(jnp.abs(by_u), jnp.abs(also))
    inside = jnp.max(jnp.abs(by_x - by_x @ onto), axis=1) <= small
    h, (lo, hi) = problem.path_constraints(t, x, u), bounds_of(problem.path_bounds, p, dtype)
    met = (h >= lo - small) & (h <= hi + small)
    still = jnp.all(steered == 0, axis=1) & (timed | (by_t == 0))
    return inside & met & still & (length > 0)
