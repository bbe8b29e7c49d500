"""Bounds of every unknown of a transcription."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.bounds import bounds_of
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal
from jaxguide.problem import initial_bounds, initial_values, initially_free, is_free, parameters

_APART = 1e-6  # the least distance of free knots, of the horizon


class Bounds(NamedTuple):
    """Of every entry of a Primal; equal where an entry is given."""

    lo: Primal
    hi: Primal


@jax.jit
def bounds(program: Transcription) -> Bounds:
    """Bounds, scaled. Entries of `x0` and `times` that are given have both equal."""
    problem, scale, size = program.problem, program.scale, program.sizes
    dtype = program.dtype
    over = lambda b, *lead: jnp.broadcast_to(b, (*lead, *b.shape))
    number = lambda v: jnp.asarray(v, dtype)

    def scalar(entry: Any) -> tuple[Array, Array]:
        if is_free(entry):
            return number(entry.lo), number(entry.hi)
        return number(entry), number(entry)

    states = bounds_of(problem.state_bounds, size.n, dtype)
    start, free = initial_values(problem, dtype), jnp.asarray(initially_free(problem))
    x0 = [jnp.where(free, side, start) for side in initial_bounds(problem)]
    times = [scalar(problem.initial_time), scalar(problem.final_time)]
    if is_free(problem.final_time) and not is_free(problem.initial_time):
        times[1] = (jnp.maximum(times[1][0], times[0][0]), times[1][1])
    if is_free(problem.initial_time) and not is_free(problem.final_time):
        times[0] = (times[0][0], jnp.minimum(times[0][1], times[1][0]))
    times += [(number(-jnp.inf), number(jnp.inf))] * (size.times - 2)
    p = [scalar(v) for v in parameters(problem)]
    controls = bounds_of(problem.control_bounds, size.m, dtype)
    path = bounds_of(problem.path_bounds, size.path, dtype)
    end = bounds_of(problem.endpoint_bounds, size.end - len(program.order), dtype)
    apart = (
        jnp.full(len(program.order), _APART, dtype),
        jnp.full(len(program.order), jnp.inf, dtype),
    )

    u = [over(b / scale.u, size.segments, size.nodes) for b in controls]
    x = [over(b / scale.x, size.segments, size.after) for b in states]
    h = [over(b / scale.path, size.segments, size.nodes) for b in path]
    if program.arcwise is not None:
        at = program.arcwise.held[:, None]
        u = [jnp.where(at > 0, u[1], u[0]), jnp.where(at < 0, u[0], u[1])]
        inner, last = jnp.split(program.arcwise.released, 2, axis=1)
        free = jnp.concatenate([jnp.repeat(inner, size.after - 1, axis=1), last], axis=1)
        x = [jnp.where(free, side, b) for side, b in zip((-jnp.inf, jnp.inf), x, strict=True)]
        free = program.arcwise.unpathed[:, None]
        h = [jnp.where(free, side, b) for side, b in zip((-jnp.inf, jnp.inf), h, strict=True)]

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

    return Bounds(side(0), side(1))
