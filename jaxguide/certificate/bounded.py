"""Bounds and their covectors: how far values lie outside, and what covectors may not be."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.problem import bounds_of
from jaxguide.sizes import largest_bound, positive


def slackness(
    multiplier: Float[Array, " k"], values: Float[Array, " k"], bounds: Any, size: Array
) -> Float[Array, " k"]:
    """|multiplier| times the distance from the bound that its sign names, in sizes: zero where a
    bound is active with the right sign, or let go."""
    lo, hi = bounds_of(bounds, values.shape[0], values.dtype)
    distance = jnp.where(multiplier > 0, hi - values, values - lo) / size
    # Beyond a size of one, as for a bound at infinity, the multiplier alone counts.
    return jnp.abs(multiplier) * jnp.clip(distance, 0.0, 1.0)


def overstep(values: Float[Array, "*k c"], bounds: Any) -> Float[Array, "*k c"]:
    """How far `values` lie outside their bounds."""
    sides = bounds_of(bounds, values.shape[-1], values.dtype)
    lo, hi = (jnp.broadcast_to(b, values.shape) for b in sides)
    return jnp.maximum(lo - values, 0.0) + jnp.maximum(values - hi, 0.0)


def bound_size(values: Float[Array, " k"], bounds: Any) -> Float[Array, " k"]:
    """The largest of a value and its finite bounds; 1 if that is zero."""
    return positive(jnp.maximum(jnp.abs(values), largest_bound(bounds, values.shape[0])))
