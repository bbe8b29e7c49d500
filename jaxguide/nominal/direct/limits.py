"""Bounds of every unknown of a transcription, in its scaled units."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.arrays import Array, on_numpy, put, traced_once, xp
from jaxguide.bounds import bounds_of
from jaxguide.nominal.direct.implied import implied_at_ends, may_be_implied
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal
from jaxguide.problem import (
    Problem,
    count,
    endpoint_count,
    initial_bounds,
    initial_values,
    initially_free,
    is_free,
    parameters,
)

# Least distance of successive free knots, as a share of the horizon's unit. Chosen, not tuned: far
# below any arc that matters, far above the rounding of times.
_APART = 1e-6

_Side = tuple[Array, Array]  # lower, upper


class Limits(NamedTuple):
    """Lower and upper bounds of every entry of a Primal; equal where an entry is given."""

    lo: Primal
    hi: Primal


@traced_once
def limits_of(program: Transcription) -> Limits:
    """Bounds of the unknowns, scaled. Given entries of `x0`, `times` and `p` have both equal."""
    scale, counts, dtype = program.scale, program.counts, program.dtype
    over = lambda b, *lead: xp.broadcast_to(b, (*lead, *b.shape))
    own = _own_bounds
    if on_numpy(program.edges):
        own = lambda *a: jax.device_get(_own_bounds_program(*a))
    x0, states, controls, times, p, path, end = own(program.problem, counts.times)
    apart = [np.full(len(program.order), v, dtype) for v in (_APART, np.inf)]

    u = [over(b / scale.u, counts.segments, counts.nodes) for b in controls]
    x = [over(b / scale.x, counts.segments, counts.after) for b in states]
    h = [over(b / scale.path, counts.segments, counts.nodes) for b in path]
    if program.arcwise is not None:
        x, u, h = _on_arcs(program, x, u, h)
    if may_be_implied(program.problem):
        x, h = _without_implied(program, x, h)

    def side(i: int) -> Primal:
        return Primal(
            x0[i] / scale.x,
            x[i],
            u[i],
            times[i] / scale.t,
            p[i] / scale.p,
            h[i],
            xp.concatenate([end[i] / scale.end[: len(end[i])], apart[i]]),
        )

    return Limits(side(0), side(1))


def _own_bounds(problem: Problem, clocks: int) -> Any:
    """Bounds in user units, of whatever mesh: of the initial state, states, controls, times,
    parameters, path and endpoint constraints."""
    dtype, n = jnp.result_type(float), problem.n
    start, free = initial_values(problem, dtype), jnp.asarray(initially_free(problem))
    x0 = tuple(jnp.where(free, side, start) for side in initial_bounds(problem))
    times = _time_bounds(problem, clocks)
    p = [_entry_bounds(v, dtype) for v in parameters(problem)]
    pair = lambda sides: tuple(
        jnp.stack([s[i] for s in sides]) if sides else jnp.zeros(0, dtype) for i in (0, 1)
    )
    return (
        x0,
        bounds_of(problem.state_bounds, n, dtype),
        bounds_of(problem.control_bounds, problem.m, dtype),
        pair(times),
        pair(p),
        bounds_of(problem.path_bounds, count(problem, "path_constraints"), dtype),
        bounds_of(problem.endpoint_bounds, endpoint_count(problem), dtype),
    )


_own_bounds_program = jax.jit(_own_bounds, static_argnums=1)


def _entry_bounds(entry: Any, dtype: Any) -> _Side:
    """Bounds of a time or parameter: of a `Free` its own, of a number that number twice."""
    number = lambda v: jnp.asarray(v, dtype)
    if is_free(entry):
        return number(entry.lo), number(entry.hi)
    return number(entry), number(entry)


def _time_bounds(problem: Problem, clocks: int) -> list[_Side]:
    """Bounds of t0, tf and the free knots, in user units. The end may not precede a given start,
    nor a free start follow a given end."""
    dtype = jnp.result_type(float)
    number = lambda v: jnp.asarray(v, dtype)
    times = [_entry_bounds(t, dtype) for t in (problem.initial_time, problem.final_time)]
    if is_free(problem.final_time) and not is_free(problem.initial_time):
        times[1] = (jnp.maximum(times[1][0], times[0][0]), times[1][1])
    if is_free(problem.initial_time) and not is_free(problem.final_time):
        times[0] = (times[0][0], jnp.minimum(times[0][1], times[1][0]))
    return times + [(number(-jnp.inf), number(jnp.inf))] * (clocks - 2)


def _without_implied(
    program: Transcription, x: list[Array], h: list[Array]
) -> tuple[list[Array], list[Array]]:
    """Bounds of states and path constraints, less those at the ends that other conditions imply."""
    found = implied_at_ends(program.problem)
    if on_numpy(program.edges):
        found = jax.device_get(found)
    nodes, sides = program.rule.nodes, (-xp.inf, xp.inf)
    free = lambda b, at, which, side: put(b, at, xp.where(which, side, b[at]))
    x = [free(b, np.s_[-1, -1], found.state, s) for b, s in zip(x, sides, strict=True)]
    ends = (
        (nodes[0] == -1.0, np.s_[0, 0], found.first),
        (nodes[-1] == 1.0, np.s_[-1, -1], found.last),
    )
    for is_node, at, which in ends:
        if is_node:
            h = [free(b, at, which, s) for b, s in zip(h, sides, strict=True)]
    return x, h


def _on_arcs(
    program: Transcription, x: list[Array], u: list[Array], h: list[Array]
) -> tuple[list[Array], list[Array], list[Array]]:
    """Bounds of states, controls and path constraints on arcs: held controls are given, and the
    states and path constraints that they determine are unbounded."""
    assert program.arcwise is not None
    at = program.arcwise.held[:, None]
    u = [xp.where(at > 0, u[1], u[0]), xp.where(at < 0, u[0], u[1])]
    loose = xp.split(program.arcwise.loose, 2, axis=1)
    u = [xp.where(a, side, b) for a, side, b in zip(loose, (-xp.inf, xp.inf), u, strict=True)]
    inner, last = xp.split(program.arcwise.released, 2, axis=1)
    free = xp.concatenate([xp.repeat(inner, program.counts.after - 1, axis=1), last], axis=1)
    x = [xp.where(free, side, b) for side, b in zip((-xp.inf, xp.inf), x, strict=True)]
    free = program.arcwise.unpathed[:, None]
    h = [xp.where(free, side, b) for side, b in zip((-xp.inf, xp.inf), h, strict=True)]
    return x, u, h
