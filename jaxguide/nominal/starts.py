"""Random controls and final times to start from: one way to draw them for every method."""

from typing import Any

from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.bounds import bounds_of
from jaxguide.problem import Problem, is_free

# Half the range of a control without bounds, in its own units: about half a turn, if it is an angle
# in radians. A first choice, which found the optima of the library's problems.
UNBOUNDED = 3.0


def control_ends(
    problem: Problem, draws: Float[Array, "*start two m"], centre: Float[Array, " m"], width: Any
) -> Float[Array, "*start two m"]:
    """Controls at both ends of a straight line in time, from `draws` on [-1, 1].

    **Arguments:** `centre`: where the draw 0 leads; `width`: half the range of a control that has
    no bounds (`UNBOUNDED`, say); one with bounds has half the distance between them.
    """
    lo, hi = bounds_of(problem.control_bounds, problem.m, draws.dtype)
    finite = xp.isfinite(lo) & xp.isfinite(hi)
    lead = (None,) * (draws.ndim - 1)
    return centre[lead] + xp.where(finite, (hi - lo) / 2, width)[lead] * draws


def bounds_middle(problem: Problem, dtype: Any) -> Float[Array, " m"]:
    """The middle of each control's bounds, 0 where it has none."""
    lo, hi = bounds_of(problem.control_bounds, problem.m, dtype)
    return xp.where(xp.isfinite(lo) & xp.isfinite(hi), (lo + hi) / 2, 0.0)


def drawn_final_time(problem: Problem, draw: Array, t0: Array, tf: Array) -> Array:
    """A final time whose horizon is that of the guess `tf` times exp(`draw`), within its bounds;
    `tf` itself where it is given."""
    spec = problem.final_time
    if not is_free(spec):
        return tf
    lo, hi = xp.asarray(spec.lo, tf.dtype), xp.asarray(spec.hi, tf.dtype)
    return xp.clip(t0 + (tf - t0) * xp.exp(draw), lo, hi)
