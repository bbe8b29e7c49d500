"""Random controls and final times to start from: one way to draw them for every method."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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
    finite = jnp.isfinite(lo) & jnp.isfinite(hi)
    lead = (None,) * (draws.ndim - 1)
    return centre[lead] + jnp.where(finite, (hi - lo) / 2, width)[lead] * draws


def bounds_middle(problem: Problem, dtype: Any) -> Float[Array, " m"]:
    """The middle of each control's bounds, 0 where it has none."""
    lo, hi = bounds_of(problem.control_bounds, problem.m, dtype)
    return jnp.where(jnp.isfinite(lo) & jnp.isfinite(hi), (lo + hi) / 2, 0.0)


def drawn_final_time(problem: Problem, key: Array, t0: Array, tf: Array, spread: float) -> Array:
    """A final time whose horizon is that of the guess `tf` times exp(-spread) to exp(spread),
    evenly in the logarithm and within its bounds; `tf` itself where it is given."""
    spec = problem.final_time
    if not is_free(spec):
        return tf
    factor = jnp.exp(jax.random.uniform(key, (), tf.dtype, -spread, spread))
    lo, hi = jnp.asarray(spec.lo, tf.dtype), jnp.asarray(spec.hi, tf.dtype)
    return jnp.clip(t0 + (tf - t0) * factor, lo, hi)
