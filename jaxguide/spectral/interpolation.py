"""Barycentric interpolation of arrays, on one grid or on many segments."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.spectral.barycentric import Real, as_nodes, like
from jaxguide.spectral.barycentric import interpolation_matrix as interpolation_matrix


def interpolate(
    x: Float[Real, " n"],
    values: Float[Real, " n *shape"],
    query: Float[Real, ""] | Float[Real, " q"] | float | int,
    weights: Float[Real, " n"] | None = None,
) -> Float[Array, "*any"]:
    """The polynomial through `(x, values)` at `query`.

    **Arguments:** `x`: distinct nodes; `values`: one entry a node, of any shape; `query`: scalar or
    vector, in the unit of `x`; `weights`: `barycentric_weights(x)` if at hand, no others.

    **Returns:** values at `query`, shape `query.shape + shape`. Exactly the given ones at nodes.
    Differentiable in `x`, `values` and `query`, nodes included, forward and reverse.

    **Error:** of rounding, n eps times the Lebesgue constant of the nodes times max|values|.

    **Raises:** `ValueError` if shapes disagree or known nodes coincide.

    **Source:** Berrut & Trefethen, SIAM Review 46 (2004), eq. (4.2).
    """
    x = as_nodes(like(x, values))
    values, query = like(values, x), like(query, x)
    if values.ndim < 1 or values.shape[0] != x.size:
        raise ValueError(f"{x.size} nodes need as many values, got shape {values.shape}.")
    if query.ndim > 1:
        raise ValueError(f"query must be a scalar or a vector, got shape {query.shape}.")
    rows = interpolation_matrix(x, query.reshape(-1), weights)
    out = jnp.tensordot(rows, values, axes=1, precision=jax.lax.Precision.HIGHEST)
    return out if query.ndim else out[0]


def interpolate_piecewise(
    breaks: Float[Real, " breaks"],
    values: Float[Real, " segment p *shape"],
    t: Float[Real, ""] | float | int,
    nodes: Float[Real, " p"],
) -> Float[Array, "*shape"]:
    """A piecewise polynomial at `t`.

    Right-continuous: at an inner break the later segment's value counts. Segments of zero length
    are skipped. Before the first break and after the last, the value there is held.

    **Arguments:** `breaks`: ends of the segments, ascending, repeats allowed; `values`: at the
    reference `nodes` of each segment; `t`: in the unit of `breaks`; `nodes`: on [-1, 1], the same
    in all segments (`nodes_lg`, `nodes_lgl`, ...).

    **Returns:** the value, shape `shape`. Differentiable in `t`, `breaks`, `values` (at the range's
    ends, the derivative of the inside).

    **Error:** that of `interpolate`, plus eps |t| over the segment's length times the slope.

    **Raises:** `ValueError` if shapes disagree.

    **Source:** review (2012), eqs. (5), (7), a segment at a time.
    """
    breaks = like(breaks, values)
    values, t, nodes = (like(a, breaks) for a in (values, t, nodes))
    if breaks.ndim != 1 or breaks.size < 2 or t.ndim:
        raise ValueError(
            f"breaks must be a vector of 2 or more and t a scalar (vmap over t), got shapes "
            f"{breaks.shape} and {t.shape}."
        )
    if values.shape[:2] != (breaks.size - 1, nodes.size):
        raise ValueError(
            f"values must have shape (segments, nodes, ...) = {(breaks.size - 1, nodes.size)} + "
            f"(...), got {values.shape}."
        )
    first, last = breaks[0], breaks[-1]
    # Not jnp.clip: its derivative at the ends is 1/2 or 0.
    t = jnp.where(t < first, first, jnp.where(t > last, last, t))
    # There are few segments, so comparing with all is quicker than a search loop, above all under
    # vmap.
    after = jnp.searchsorted(breaks, t, side="right", method="compare_all")
    end = jnp.searchsorted(breaks, last, side="left", method="compare_all")
    i = jnp.maximum(jnp.minimum(after, end) - 1, 0)
    length = breaks[i + 1] - breaks[i]
    empty = length <= 0  # only if all segments are
    tau = jnp.where(empty, -1, 2 * (t - breaks[i]) / jnp.where(empty, 1, length) - 1)
    return interpolate(nodes, values[i], tau)


def interval(breaks: Float[Array, " k"], t: Any) -> Array:
    """Index of the interval between `breaks` that holds the scalar `t`; beyond the ends, of the
    nearest one."""
    after = jnp.searchsorted(breaks, t, side="right", method="compare_all")
    return jnp.clip(after - 1, 0, breaks.shape[0] - 2)
