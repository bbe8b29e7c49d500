"""The barycentric formula: weights, differentiation and interpolation matrices of any nodes."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

Real = Array | np.ndarray  # host constants are welcome wherever an array is


def as_nodes(x: Float[Real, " n"], least: int = 1) -> Float[Array, " n"]:
    """`x` as a JAX array, checked as far as a trace allows.

    **Raises:** `ValueError` if `x` is not one-dimensional, has fewer than `least` entries or, when
    its values are known, repeats one or holds a NaN.
    """
    x = jnp.asarray(x)
    if x.ndim != 1 or x.size < least:
        raise ValueError(f"nodes must be a vector of {least} or more, got shape {x.shape}.")
    if not isinstance(x, Tracer):
        gaps = np.diff(np.sort(np.asarray(x)))
        if not np.all(gaps > 0):
            raise ValueError(f"nodes must be distinct numbers, got {x}: remove the repeated ones.")
    return x


def like(value, reference) -> Array:
    """`value` as a JAX array; a host constant takes the dtype of `reference`, if that is one.

    So host constants follow the arrays that they are combined with, and arrays are never cast.
    """
    if isinstance(value, jax.Array) or not isinstance(reference, jax.Array):
        return jnp.asarray(value)
    return jnp.asarray(value, reference.dtype)


def barycentric_weights(x: Float[Real, " n"]) -> Float[Array, " n"]:
    r"""$w_j = 1 / \prod_{k \ne j} g (x_j - x_k)$ with $g = 4 / (\max x - \min x)$.

    Scaling by the capacity (max - min) / 4 of the interval keeps the products near 1: at n = 512
    the weights are between 4e-7 and 3e-3 for Gaussian nodes, which float32 bears, and between
    3e-88 and 8e64 for uniform ones, which float64 does.

    **Arguments:** `x`: distinct nodes, any order (ascending is best), any interval.

    **Returns:** weights, dimensionless; differentiable in `x`.

    **Error:** relative, about $\epsilon \sqrt n$ (each of n differences is rounded once).

    **Raises:** `ValueError` if known nodes coincide; traced ones give inf.

    **Source:** Berrut & Trefethen, SIAM Review 46 (2004), eq. (3.2) and section 7.
    """
    x = as_nodes(x)
    n = x.size
    if n == 1:
        return jnp.ones_like(x)
    dx = (x[:, None] - x[None, :]) * (4 / (jnp.max(x) - jnp.min(x)))
    dx = jnp.where(jnp.eye(n, dtype=bool), jnp.ones_like(dx), dx)
    # A tree of products pairing factors half the grid apart: each partial product is one over
    # spread nodes and stays near 1, where a run of neighbours would overflow float32. Not
    # `jnp.prod` in stages, which XLA merges into one running product.
    while dx.shape[1] > 1:
        half = (dx.shape[1] + 1) // 2
        rest = jnp.pad(dx[:, half:], ((0, 0), (0, 2 * half - dx.shape[1])), constant_values=1)
        dx = dx[:, :half] * rest
    return 1 / dx[:, 0]


def differentiation_matrix(
    x: Float[Real, " n"], weights: Float[Real, " n"] | None = None
) -> Float[Array, "n n"]:
    r"""Matrix with $(D f)_i = p'(x_i)$, $p$ interpolating $(x_j, f_j)$; review eq. (13).

    **Arguments:** `x`: distinct nodes; `weights`: `barycentric_weights(x)` if at hand.

    **Returns:** `D` per unit of `x`; times $2/(t_f - t_0)$ gives 1/s. Differentiable in `x`.

    **Error:** exact below degree n, to rounding of order $n^2 \epsilon$ on Gaussian nodes.

    **Raises:** `ValueError` if known nodes coincide.

    **Source:** Berrut & Trefethen, SIAM Review 46 (2004), eqs. (9.4), (9.5).
    """
    x = as_nodes(x)
    w = barycentric_weights(x) if weights is None else like(weights, x)
    eye = jnp.eye(x.size, dtype=x.dtype)
    d = (w[None, :] / w[:, None] - eye) / (x[:, None] - x[None, :] + eye)
    return d - jnp.diag(jnp.sum(d, axis=1))  # negative-sum trick: D @ 1 = 0


def interpolation_matrix(
    x: Float[Real, " n"],
    query: Float[Real, " q"],
    weights: Float[Real, " n"] | None = None,
) -> Float[Array, "q n"]:
    r"""Matrix of the Lagrange polynomials: $M_{ij} = \phi_j(q_i)$; review eqs. (7), (8).

    A query equal to a node gives a row of the identity. All derivatives, in `x` and `query`,
    forward and reverse, of any order, hold at nodes too.

    **Arguments:** `x`: distinct nodes; `query`: points, inside or a little outside the nodes
    (far outside, use a series: the formula then loses accuracy); `weights`:
    `barycentric_weights(x)` if at hand, no others: derivatives assume a polynomial.

    **Returns:** `M`, dimensionless, rows summing to 1.

    **Error:** times the values, $n \epsilon$ times the Lebesgue constant.

    **Raises:** `ValueError` if known nodes coincide or `query` is not a vector.

    **Source:** Berrut & Trefethen, SIAM Review 46 (2004), eq. (4.2); derivatives: see `_rows`.
    """
    x = as_nodes(x)
    query = like(query, x)
    if query.ndim != 1:
        raise ValueError(f"query must be a vector, got shape {query.shape}: reshape it first.")
    w = barycentric_weights(x) if weights is None else like(weights, x)
    return _rows(x, w, query)


@jax.custom_jvp
def _rows(x, w, query):
    dx = query[:, None] - x[None, :]
    hit = dx == 0
    nearest = jnp.min(jnp.abs(dx), axis=1, keepdims=True)
    # w / dx times the least |dx|: no overflow beside a node.
    ratio = jnp.where(hit, jnp.ones_like(dx), nearest / jnp.where(hit, jnp.ones_like(dx), dx))
    terms = w[None, :] * ratio
    rows = terms / jnp.sum(terms, axis=1, keepdims=True)
    # At a node only its own term is left, but XLA may divide by multiplying with a rounded
    # reciprocal: say 1 outright.
    return jnp.where(jnp.any(hit, axis=1, keepdims=True), hit.astype(rows.dtype), rows)


@_rows.defjvp
def _rows_jvp(primals, tangents):
    # p' is the interpolant of D f. Moving x_j with f_j held changes p by the polynomial which is
    # -p'(x_j) dx_j at x_j and 0 at the other nodes: the interpolant of -dx * (D f). No division by
    # query - x is left, so nodes are ordinary points. The weights are a function of x, already
    # accounted for.
    x, w, query = primals
    x_dot, _, query_dot = tangents
    rows = _rows(x, w, query)
    d = differentiation_matrix(x, w)
    moved = query_dot[:, None] * rows - rows * x_dot[None, :]
    return rows, jnp.matmul(moved, d, precision=jax.lax.Precision.HIGHEST)
