"""What a Problem states about its boundary, in user units and for any mesh: bounds of everything,
and where a search may begin. On the host both are one small program."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, on_numpy
from jaxguide.bounds import bounds_of
from jaxguide.host.compilation import compiled
from jaxguide.nominal.ends import horizon_guess, nearest_ends
from jaxguide.problem import (
    Problem,
    count,
    endpoint_count,
    initial_bounds,
    initial_values,
    initially_free,
    is_free,
    parameters,
    start_control,
    start_value,
    with_parameters,
)

Side = tuple[Array, Array]  # lower, upper


class Bounds(NamedTuple):
    """(lower, upper) of the initial state, states, controls, (t0, tf), parameters, path and
    endpoint constraints; equal where a number is given."""

    x0: Side
    x: Side
    u: Side
    times: Side
    p: Side
    path: Side
    end: Side


class Beginning(NamedTuple):
    """Times, ends that meet the endpoint constraints, a control and parameters to begin with.
    `unasked`: which final states no endpoint constraint depends on there."""

    t0: Float[Array, ""]
    tf: Float[Array, ""]
    x0: Float[Array, " n"]
    xf: Float[Array, " n"]
    u: Float[Array, " m"]
    p: Float[Array, " k"]
    unasked: Bool[Array, " n"]


def stated_bounds(problem: Problem) -> Bounds:
    """The bounds of `problem`."""
    return _on_either(_bounds, problem, 0)


def beginning(problem: Problem) -> Beginning:
    """Where a search may begin."""
    return _on_either(_beginning, problem, 1)


def _on_either(function: Any, problem: Problem, which: int) -> Any:
    if on_numpy(*jax.tree_util.tree_leaves(problem)):
        return jax.device_get(compiled(_both, True)(problem))[which]
    return function(problem)


def _both(problem: Problem) -> tuple[Bounds, Beginning]:
    return _bounds(problem), _beginning(problem)


def _bounds(problem: Problem) -> Bounds:
    dtype, n = jnp.result_type(float), problem.n
    start, free = initial_values(problem, dtype), jnp.asarray(initially_free(problem))
    low, high = initial_bounds(problem)
    return Bounds(
        (jnp.where(free, low, start), jnp.where(free, high, start)),
        bounds_of(problem.state_bounds, n, dtype),
        bounds_of(problem.control_bounds, problem.m, dtype),
        _pair(_time_bounds(problem)),
        _pair([_entry_bounds(v, dtype) for v in parameters(problem)]),
        bounds_of(problem.path_bounds, count(problem, "path_constraints"), dtype),
        bounds_of(problem.endpoint_bounds, endpoint_count(problem), dtype),
    )


def _pair(sides: list[Side]) -> Side:
    none = jnp.zeros(0, jnp.result_type(float))
    lower, upper = zip(*sides, strict=True) if sides else ((), ())
    return (jnp.stack(lower), jnp.stack(upper)) if sides else (none, none)


def _entry_bounds(entry: Any, dtype: Any) -> Side:
    """Bounds of a time or parameter: of a `Free` its own, of a number that number twice."""
    number = lambda v: jnp.asarray(v, dtype)
    if is_free(entry):
        return number(entry.lo), number(entry.hi)
    return number(entry), number(entry)


def _time_bounds(problem: Problem) -> list[Side]:
    """Bounds of t0 and tf, in user units. The end may not precede a given start, nor a free start
    follow a given end."""
    dtype = jnp.result_type(float)
    times = [_entry_bounds(t, dtype) for t in (problem.initial_time, problem.final_time)]
    if is_free(problem.final_time) and not is_free(problem.initial_time):
        times[1] = (jnp.maximum(times[1][0], times[0][0]), times[1][1])
    if is_free(problem.initial_time) and not is_free(problem.final_time):
        times[0] = (times[0][0], jnp.minimum(times[0][1], times[1][0]))
    return times


def _beginning(problem: Problem) -> Beginning:
    dtype, known = jnp.result_type(float), with_parameters(problem, None)
    t0, tf = horizon_guess(problem)
    x0, xf = nearest_ends(problem, t0, tf)
    unasked = jnp.ones(problem.n, bool)
    if endpoint_count(problem):
        ends_at = lambda xf: known.endpoint_constraints(x0, xf, t0, tf)
        unasked = ~jnp.any(jax.jacfwd(ends_at)(xf) != 0, axis=0)
    p = [jnp.asarray(start_value(v), dtype) for v in parameters(problem)]
    p = jnp.stack(p) if p else jnp.zeros(0, dtype)
    return Beginning(t0, tf, x0, xf, start_control(problem, dtype), p, unasked)
