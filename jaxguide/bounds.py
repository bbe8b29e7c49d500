"""Bounds: how far values lie outside them, and what the covectors that hold them may not be."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float


def bounds_of(bounds: Any, size: int, dtype: Any) -> tuple[Array, Array]:
    """`(lower, upper)` broadcast to `(size,)` each."""
    lower, upper = bounds
    return (
        jnp.broadcast_to(jnp.asarray(lower, dtype), (size,)),
        jnp.broadcast_to(jnp.asarray(upper, dtype), (size,)),
    )


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


def largest_bound(bounds: Any, k: int) -> Float[Array, " k"]:
    """The larger finite bound, or 0."""
    both = jnp.stack(bounds_of(bounds, k, jnp.result_type(float)))
    return jnp.max(jnp.where(jnp.isfinite(both), jnp.abs(both), 0.0), axis=0)


def positive(size: Array) -> Array:
    return jnp.where(size > 0, size, 1.0)
