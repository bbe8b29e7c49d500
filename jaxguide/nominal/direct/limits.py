"""Bounds of every unknown of a transcription, in its scaled units."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.bounds import bounds_of
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal
from jaxguide.problem import initial_bounds, initial_values, initially_free, is_free, parameters

# Least distance of successive free knots, as a share of the horizon's unit. Chosen, not tuned: far
# below any arc that matters, far above the rounding of times.
_APART = 1e-6

_Side = tuple[Array, Array]  # lower, upper


class Limits(NamedTuple):
    """Lower and upper bounds of every entry of a Primal; equal where an entry is given."""

    lo: Primal
    hi: Primal


@jax.jit
def limits_of(program: Transcription) -> Limits:
    """Bounds of the unknowns, scaled. Given entries of `x0`, `times` and `p` have both equal."""
    problem, scale, counts = program.problem, program.scale, program.counts
    dtype = program.dtype
    over = lambda b, *lead: jnp.broadcast_to(b, (*lead, *b.shape))

    states = bounds_of(problem.state_bounds, counts.n, dtype)
    start, free = initial_values(problem, dtype), jnp.asarray(initially_free(problem))
    x0 = [jnp.where(free, side, start) for side in initial_bounds(problem)]
    times = _time_bounds(program)
    p = [_entry_bounds(v, dtype) for v in parameters(problem)]
    controls = bounds_of(problem.control_bounds, counts.m, dtype)
    path = bounds_of(problem.path_bounds, counts.path, dtype)
    end = bounds_of(problem.endpoint_bounds, counts.end - len(program.order), dtype)
    apart = (
        jnp.full(len(program.order), _APART, dtype),
        jnp.full(len(program.order), jnp.inf, dtype),
    )

    u = [over(b / scale.u, counts.segments, counts.nodes) for b in controls]
    x = [over(b / scale.x, counts.segments, counts.after) for b in states]
    h = [over(b / scale.path, counts.segments, counts.nodes) for b in path]
    if program.arcwise is not None:
        x, u, h = _on_arcs(program, x, u, h)

    def side(i: int) -> Primal:
        return Primal(
            x0[i] / scale.x,
            x[i],
            u[i],
            jnp.stack([t[i] for t in times]) / scale.t,
            (jnp.stack([v[i] for v in p]) if p else jnp.zeros(0, dtype)) / scale.p,
            h[i],
            jnp.concatenate([end[i] / scale.end[: len(end[i])], apart[i]]),
        )

    return Limits(side(0), side(1))


def _entry_bounds(entry: Any, dtype: Any) -> _Side:
    """Bounds of a time or parameter: of a `Free` its own, of a number that number twice."""
    number = lambda v: jnp.asarray(v, dtype)
    if is_free(entry):
        return number(entry.lo), number(entry.hi)
    return number(entry), number(entry)


def _time_bounds(program: Transcription) -> list[_Side]:
    """Bounds of t0, tf and the free knots, in user units. The end may not precede a given start,
    nor a free start follow a given end."""
    problem, dtype = program.problem, program.dtype
    number = lambda v: jnp.asarray(v, dtype)
    times = [_entry_bounds(t, dtype) for t in (problem.initial_time, problem.final_time)]
    if is_free(problem.final_time) and not is_free(problem.initial_time):
        times[1] = (jnp.maximum(times[1][0], times[0][0]), times[1][1])
    if is_free(problem.initial_time) and not is_free(problem.final_time):
        times[0] = (times[0][0], jnp.minimum(times[0][1], times[1][0]))
    return times + [(number(-jnp.inf), number(jnp.inf))] * (program.counts.times - 2)


def _on_arcs(
    program: Transcription, x: list[Array], u: list[Array], h: list[Array]
) -> tuple[list[Array], list[Array], list[Array]]:
    """Bounds of states, controls and path constraints on arcs: held controls are given, and the
    states and path constraints that they determine are unbounded."""
    assert program.arcwise is not None
    at = program.arcwise.held[:, None]
    u = [jnp.where(at > 0, u[1], u[0]), jnp.where(at < 0, u[0], u[1])]
    inner, last = jnp.split(program.arcwise.released, 2, axis=1)
    free = jnp.concatenate([jnp.repeat(inner, program.counts.after - 1, axis=1), last], axis=1)
    x = [jnp.where(free, side, b) for side, b in zip((-jnp.inf, jnp.inf), x, strict=True)]
    free = program.arcwise.unpathed[:, None]
    h = [jnp.where(free, side, b) for side, b in zip((-jnp.inf, jnp.inf), h, strict=True)]
    return x, u, h
