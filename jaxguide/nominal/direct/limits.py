"""Bounds of every unknown of a transcription, in its scaled units."""

from typing import NamedTuple

import jax
import numpy as np

from jaxguide.arrays import Array, on_numpy, put, traced_once, xp
from jaxguide.nominal.direct.implied import implied_at_ends, may_be_implied
from jaxguide.nominal.direct.stated import stated_bounds
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal

# Least distance of successive free knots, as a share of the horizon's unit. Chosen, not tuned: far
# below any arc that matters, far above the rounding of times.
_APART = 1e-6


class Limits(NamedTuple):
    """Lower and upper bounds of every entry of a Primal; equal where an entry is given."""

    lo: Primal
    hi: Primal


@traced_once
def limits_of(program: Transcription) -> Limits:
    """Bounds of the unknowns, scaled. Given entries of `x0`, `times` and `p` have both equal."""
    scale, counts, dtype = program.scale, program.counts, program.dtype
    over = lambda b, *lead: xp.broadcast_to(b, (*lead, *b.shape))
    own = stated_bounds(program.problem)
    apart = [np.full(len(program.order), v, dtype) for v in (_APART, np.inf)]
    anywhere = [np.full(counts.times - 2, v, dtype) for v in (-np.inf, np.inf)]

    u = [over(b / scale.u, counts.segments, counts.nodes) for b in own.u]
    x = [over(b / scale.x, counts.segments, counts.after) for b in own.x]
    h = [over(b / scale.path, counts.segments, counts.nodes) for b in own.path]
    if program.arcwise is not None:
        x, u, h = _on_arcs(program, x, u, h)
    if may_be_implied(program.problem):
        x, h = _without_implied(program, x, h)

    def side(i: int) -> Primal:
        return Primal(
            own.x0[i] / scale.x,
            x[i],
            u[i],
            xp.concatenate([own.times[i] / scale.t, anywhere[i]]),
            own.p[i] / scale.p,
            h[i],
            xp.concatenate([own.end[i] / scale.end[: len(own.end[i])], apart[i]]),
        )

    return Limits(side(0), side(1))


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
