"""Natural units of a problem's states and controls: how large each is likely to be."""

from typing import Any

import jax
from jaxtyping import Float

from jaxguide.arrays import Array, on_numpy, traced_once, xp
from jaxguide.bounds import bounds_of
from jaxguide.problem import Problem
from jaxguide.problem.points import slopes

# A value below it is at rest at zero: the square root of rounding, in the user's unit. Chosen, not
# tuned.
REST = 1e-8
# Orders of magnitude from 1 at which an unknown's size, estimated from the dynamics, is used. An
# estimate is off by a factor of ten or more, and a unit need not be closer than that. Chosen, not
# tuned.
_FAR = 3


def known_size(
    lo: Float[Array, " n"], hi: Float[Array, " n"], seen: Float[Array, "k n"]
) -> Float[Array, " n"]:
    """The larger of two finite bounds; otherwise the largest of the `seen` values, unless it is at
    rest; otherwise 0."""
    bounded = xp.isfinite(lo) & xp.isfinite(hi)
    wide = xp.where(bounded, xp.maximum(xp.abs(lo), xp.abs(hi)), 0.0)
    largest = xp.max(xp.abs(seen), axis=0)
    return xp.where(wide > 0, wide, xp.where(largest > REST, largest, 0.0))


@traced_once
def natural_units(
    problem: Problem,
    times: Float[Array, " clock"],
    x0: Float[Array, " n"],
    x: Float[Array, "segment after n"],
    u: Float[Array, "segment node m"],
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """A unit for each state and control, of the order of its values, in user units.

    It is a bound or a value where one is known. Otherwise it is 1, unless the dynamics show that
    the size is another by orders of magnitude. They relate sizes: an unknown is as large as it must
    be to move a state of known size by as much within the horizon, or as far as quantities of known
    size move it.

    **Arguments:** a guess in user units: `times`, of which the first two are t0 and tf; `x0`, the
    state at t0; `x`, the states after the first point of each segment, the last at its end; `u`,
    the controls at each segment's nodes. Of an infinite horizon give the `transforms.evened`
    problem.
    """
    n, m, dtype = problem.n, problem.m, x.dtype
    seen = xp.concatenate([x0[None], x.reshape(-1, n)])
    x_size = known_size(*bounds_of(problem.state_bounds, n, dtype), seen)
    u_size = known_size(*bounds_of(problem.control_bounds, m, dtype), xp.zeros((1, m), dtype))
    known = xp.concatenate([x_size, u_size])
    # Small numbers alone are better than nothing.
    small = xp.concatenate([xp.max(xp.abs(seen), axis=0), xp.zeros(m, dtype)])
    known = xp.where(xp.any(known > 0), known, small)
    moves = _moves(problem, times, x0, x, u)

    def spread(_: Any, size: Array) -> Array:
        mover = xp.where((size[:n, None] > 0) & (moves > 0), size[:n, None] / moves, xp.inf)
        mover = xp.min(mover, axis=0)
        moved = xp.pad(xp.max(moves * size[None], axis=1), (0, m))
        estimate = xp.where(xp.isfinite(mover), mover, moved)
        return xp.where(size > 0, size, estimate)

    estimate = known
    if on_numpy(known):
        for _ in range(n + m):
            estimate = spread(None, estimate)
    else:
        estimate = jax.lax.fori_loop(0, n + m, spread, known)
    far = (estimate > 0) & (xp.abs(xp.log10(xp.where(estimate > 0, estimate, 1.0))) > _FAR)
    size = xp.where(known > 0, known, xp.where(far, estimate, 1.0))
    return size[:n], size[n:]


def _moves(
    problem: Problem, times: Array, x0: Array, x: Array, u: Array
) -> Float[Array, "n unknown"]:
    """By how much a unit of each state and control moves each state within the horizon: the largest
    slope of the dynamics at the start and at the segments' ends."""
    t, middle = times[0], (times[0] + times[1]) / 2
    along = (xp.broadcast_to(middle, (len(x),)), x[:, -1], u[:, -1])
    first = (t[None], x0[None], u[:1, 0])
    points = [xp.concatenate(pair) for pair in zip(first, along, strict=True)]
    n, m = x.shape[2], u.shape[2]
    moves = slopes(problem, *points).f_by[:, :, : n + m]
    moves = xp.max(xp.where(xp.isfinite(moves), xp.abs(moves), 0.0), axis=0)
    return moves * (times[1] - times[0])
