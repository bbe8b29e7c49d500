"""Where a trajectory may begin and end, before anything is solved: times and nearby states."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.conditions.units import known_size
from jaxguide.linalg import gauss_solve
from jaxguide.problem import (
    Problem,
    endpoint_count,
    initial_values,
    initially_free,
    is_free,
    start_value,
    with_parameters,
)

# Newton steps towards ends that meet the endpoint constraints, and the ridge that keeps redundant
# constraints solvable. Choices: a guess need be no better.
_END_STEPS, _RIDGE = 8, 1e-8


def horizon_guess(problem: Problem) -> tuple[Array, Array]:
    """t0 and tf, in user units: given, guessed, or one unit apart where neither is."""
    dtype = jnp.result_type(float)
    number = lambda v: jnp.asarray(v, dtype)
    start, end = problem.initial_time, problem.final_time
    t0 = number(start_value(start))
    if not is_free(end) or end.guess is not None:
        tf = number(start_value(end))
    else:
        lo, hi = number(end.lo), number(end.hi)
        bounded = jnp.isfinite(lo) & jnp.isfinite(hi)
        tf = jnp.where(bounded, start_value(end), jnp.clip(t0 + 1.0, lo, hi))
    # A time that is not given makes way for one that is.
    halfway = lambda a, b, other: jnp.where(jnp.isfinite(b), (a + b) / 2, other)
    if is_free(end) and end.guess is None:
        tf = jnp.where(tf > t0, tf, halfway(t0, number(end.hi), t0 + 1.0))
    if is_free(start) and start.guess is None:
        t0 = jnp.where(tf > t0, t0, halfway(tf, number(start.lo), tf - 1.0))
    return t0, tf


def nearest_ends(
    problem: Problem, t0: Array, tf: Array
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Initial and final states near the initial one that meet the endpoint constraints, by Newton's
    method with least steps, in units of each state's size."""
    stated, dtype, n = with_parameters(problem, None), jnp.result_type(float), problem.n
    lo, hi = bounds_of(problem.state_bounds, n, dtype)
    x0 = jnp.clip(initial_values(problem, dtype), lo, hi)
    q = endpoint_count(problem)
    e_lo, e_hi = bounds_of(problem.endpoint_bounds, q, dtype)
    known = known_size(lo, hi, x0[None])
    scale = jnp.tile(jnp.where(known > 0, known, 1.0), 2)
    # Free components of the initial state move with the final ones.
    free = jnp.concatenate([jnp.asarray(initially_free(problem)), jnp.ones(n, bool)])
    scale = jnp.where(free, scale, 0.0)
    low, high = jnp.tile(lo, 2), jnp.tile(hi, 2)

    def nearer(_: Any, ends: Array) -> Array:
        def at(y: Array) -> Array:
            moved = ends + y * scale
            return stated.endpoint_constraints(moved[:n], moved[n:], t0, tf)

        e, J = at(jnp.zeros_like(ends)), jax.jacfwd(at)(jnp.zeros_like(ends))
        # By rows of one size, lest the ridge drown those of small units.
        size = jnp.linalg.norm(J, axis=1)
        size = jnp.where(size > 0, size, 1.0)
        miss, J = (e - jnp.clip(e, e_lo, e_hi)) / size, J / size[:, None]
        step = J.T @ gauss_solve(J @ J.T + _RIDGE * q * jnp.eye(q, dtype=dtype), miss)
        step = jnp.where(jnp.isfinite(step), step, 0.0)
        return jnp.where(free, jnp.clip(ends - scale * step, low, high), ends)

    ends = jnp.tile(x0, 2)
    ends = jax.lax.fori_loop(0, _END_STEPS, nearer, ends) if q else ends
    return ends[:n], ends[n:]
