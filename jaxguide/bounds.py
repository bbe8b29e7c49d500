"""Bounds (lower, upper): by how much values overstep them, how large they are, and whether the
multipliers that hold them are complementary."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, xp
from jaxguide.types import is_traced


def bounds_of(bounds: Any, size: int, dtype: Any) -> tuple[Array, Array]:
    """`(lower, upper)` broadcast to `(size,)` each: the host's arrays unless they are traced, so
    that a Problem's property may well compute them with JAX."""
    lower, upper = bounds
    number = jnp.asarray if is_traced(bounds) else np.asarray
    over = lambda side: xp.broadcast_to(number(side, dtype), (size,))
    return over(lower), over(upper)


def joined_bounds(bounds: Any, size: int, more: Any, further: int) -> tuple[Array, Array]:
    """`bounds` of `size` components, followed by the bounds `more` of `further` components."""
    parts = (bounds_of(b, k, jnp.result_type(float)) for b, k in ((bounds, size), (more, further)))
    lower, upper = zip(*parts, strict=True)
    return xp.concatenate(lower), xp.concatenate(upper)


def overstep(values: Float[Array, "*k c"], bounds: Any) -> Float[Array, "*k c"]:
    """By how much `values` lie below their lower or above their upper bound, in their own units;
    0 within the bounds."""
    sides = bounds_of(bounds, values.shape[-1], values.dtype)
    lo, hi = (xp.broadcast_to(b, values.shape) for b in sides)
    return xp.maximum(lo - values, 0.0) + xp.maximum(values - hi, 0.0)


def touches(
    values: Float[Array, "*k c"], bounds: Any, margin: Float[Array, " c"]
) -> Bool[Array, "*k c"]:
    """Whether `values` lie on a bound, beyond it, or within `margin` of it (in their own units)."""
    sides = bounds_of(bounds, values.shape[-1], values.dtype)
    lo, hi, margin = (xp.broadcast_to(b, values.shape) for b in (*sides, margin))
    return (values <= lo + margin) | (values >= hi - margin)


def slackness(
    multiplier: Float[Array, "*lead k"], values: Float[Array, "*lead k"], bounds: Any, size: Array
) -> Float[Array, "*lead k"]:
    """By how much complementarity fails: |multiplier| times the distance to the bound that its
    sign names (lower if negative, upper if positive), in units of `size`.

    Zero where that bound is active, and where the multiplier is zero.
    """
    sides = bounds_of(bounds, values.shape[-1], values.dtype)
    lo, hi, size = (xp.broadcast_to(a, values.shape) for a in (*sides, size))
    distance = xp.where(multiplier > 0, hi - values, values - lo) / size
    # A bound at infinity is infinitely far away: at most one `size` is counted, so that the product
    # stays finite.
    return xp.abs(multiplier) * xp.clip(distance, 0.0, 1.0)


def bound_size(values: Float[Array, " k"], bounds: Any) -> Float[Array, " k"]:
    """What errors of `values` are relative to: the largest of |value| and its finite bounds; 1
    where all of them are zero."""
    return positive(xp.maximum(xp.abs(values), largest_bound(bounds, values.shape[0])))


def size_along(values: Float[Array, "node k"], bounds: Any) -> Float[Array, " k"]:
    """What errors of a quantity are relative to along a trajectory: its largest |value| over the
    nodes. Of one that is zero everywhere, its largest finite bound, and 1 where that is zero too.
    """
    largest = xp.max(xp.abs(values), axis=0)
    of_bounds = largest_bound(bounds, values.shape[1]).astype(values.dtype)
    return positive(xp.where(largest > 0, largest, of_bounds))


def largest_bound(bounds: Any, k: int) -> Float[Array, " k"]:
    """The larger absolute value of the finite ones of both bounds; 0 where neither is finite."""
    both = xp.stack(bounds_of(bounds, k, jnp.result_type(float)))
    return xp.max(xp.where(xp.isfinite(both), xp.abs(both), 0.0), axis=0)


def positive(size: Array) -> Array:
    """`size`, and 1 where it is zero: something to divide by."""
    return xp.where(size > 0, size, 1.0)
