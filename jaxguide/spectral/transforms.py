r"""Values at nodes to Legendre or Chebyshev coefficients, and back.

Coefficients that stop falling (a high "spectral tail") show that a grid is too coarse.
"""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.spectral.barycentric import Real, as_nodes, interpolation_matrix, like
from jaxguide.spectral.nodes import nodes_lg


def legendre_vandermonde(x: Float[Real, " q"], n: int) -> Float[Array, "q n"]:
    r"""$V_{ik} = P_k(x_i)$, k = 0 ... n - 1.

    **Arguments:** `x`: points on [-1, 1]; `n`: number of polynomials, at least 1.

    **Returns:** `V`, dimensionless; differentiable in `x`.

    **Error:** at most $n \epsilon$ in the interior, $n^2 \epsilon$ beside the ends.

    **Raises:** `ValueError` if `n < 1`.

    **Source:** Abramowitz & Stegun (1964), eq. 22.7.10.
    """
    k = np.arange(n, dtype=float)
    return _three_term(jnp.asarray(x), (2 * k + 1) / (k + 1), k / (k + 1))


def chebyshev_vandermonde(x: Float[Real, " q"], n: int) -> Float[Array, "q n"]:
    r"""$V_{ik} = T_k(x_i)$, k = 0 ... n - 1.

    **Arguments:** `x`: points on [-1, 1]; `n`: number of polynomials, at least 1.

    **Returns:** `V`, dimensionless; differentiable in `x`.

    **Error:** at most $n \epsilon$ in the interior, $n^2 \epsilon$ beside the ends.

    **Raises:** `ValueError` if `n < 1`.

    **Source:** Abramowitz & Stegun (1964), eq. 22.7.4.
    """
    first = np.arange(n) == 0
    return _three_term(jnp.asarray(x), np.where(first, 1.0, 2.0), np.where(first, 0.0, 1.0))


def legendre_matrix(x: Float[Real, " n"]) -> Float[Array, "n n"]:
    r"""Matrix from values at the nodes to the Legendre coefficients of their interpolant.

    $a_k = (k + 1/2) \int_{-1}^1 P_k p$, by Gauss quadrature of `p` at n LG points: exact, and
    stable where inverting the Vandermonde matrix of arbitrary nodes is not.

    **Arguments:** `x`: distinct nodes on [-1, 1] (LGL, LG, LGR, CGL or any other).

    **Returns:** the matrix, dimensionless; differentiable in `x`.

    **Error:** about $n \epsilon$ times the Lebesgue constant of the nodes.

    **Raises:** `ValueError` if known nodes coincide.

    **Source:** Canuto et al., Spectral Methods: Single Domains (2006), section 2.3.
    """
    x = as_nodes(x)
    return _matmul(jnp.asarray(_legendre_projection(x.size), x.dtype), _resample(x, nodes_lg))


def chebyshev_matrix(x: Float[Real, " n"]) -> Float[Array, "n n"]:
    r"""Matrix from values at the nodes to the Chebyshev coefficients of their interpolant.

    By Gauss-Chebyshev quadrature of the interpolant at the n zeros of $T_n$.

    **Arguments:** `x`: distinct nodes on [-1, 1] (LGL, LG, LGR, CGL or any other).

    **Returns:** the matrix, dimensionless; differentiable in `x`.

    **Error:** about $n \epsilon$ times the Lebesgue constant of the nodes.

    **Raises:** `ValueError` if known nodes coincide.

    **Source:** Canuto et al., Spectral Methods: Single Domains (2006), section 2.4.
    """
    x = as_nodes(x)
    return _matmul(jnp.asarray(_chebyshev_projection(x.size), x.dtype), _resample(x, _zeros))


def legendre_coefficients(
    x: Float[Real, " n"], values: Float[Real, " n *shape"]
) -> Float[Array, " n *shape"]:
    """Legendre coefficients of the interpolant of `values` at the distinct nodes `x`.

    **Error, Raises:** of `legendre_matrix`, which this applies.
    """
    m = legendre_matrix(like(x, values))
    return _apply(m, like(values, m))


def chebyshev_coefficients(
    x: Float[Real, " n"], values: Float[Real, " n *shape"]
) -> Float[Array, " n *shape"]:
    """Chebyshev coefficients of the interpolant of `values` at the distinct nodes `x`.

    **Error, Raises:** of `chebyshev_matrix`, which this applies.
    """
    m = chebyshev_matrix(like(x, values))
    return _apply(m, like(values, m))


def legendre_values(
    x: Float[Real, " q"], coefficients: Float[Real, " n *shape"]
) -> Float[Array, " q *shape"]:
    """Sum of the Legendre series with `coefficients` at the points `x`: the inverse of
    `legendre_coefficients`."""
    v = legendre_vandermonde(like(x, coefficients), coefficients.shape[0])
    return _apply(v, like(coefficients, v))


def chebyshev_values(
    x: Float[Real, " q"], coefficients: Float[Real, " n *shape"]
) -> Float[Array, " q *shape"]:
    """Sum of the Chebyshev series with `coefficients` at the points `x`: the inverse of
    `chebyshev_coefficients`."""
    v = chebyshev_vandermonde(like(x, coefficients), coefficients.shape[0])
    return _apply(v, like(coefficients, v))


def _three_term(x: Array, a: np.ndarray, b: np.ndarray) -> Array:
    """Columns p_0 = 1, p_{k+1} = a_k x p_k - b_k p_{k-1}; a scan, as unrolling compiles slowly."""
    if a.size < 1:
        raise ValueError(f"a series needs n >= 1 polynomials, got {a.size}.")

    def step(carry, ab):
        before, p = carry
        return (p, ab[0] * x * p - ab[1] * before), p

    ab = jnp.asarray(np.stack([a, b], axis=1), x.dtype)
    return jnp.moveaxis(jax.lax.scan(step, (jnp.zeros_like(x), jnp.ones_like(x)), ab)[1], 0, -1)


@ft.cache
def _legendre_projection(n: int) -> np.ndarray:
    x, w = nodes_lg(n)
    v = np.polynomial.legendre.legvander(x, n - 1)
    return (np.arange(n)[:, None] + 0.5) * v.T * w[None, :]


@ft.cache
def _chebyshev_projection(n: int) -> np.ndarray:
    # T_k at the zeros cos((2j + 1) pi / 2n), the angle reduced in integers.
    k, j = np.arange(n)[:, None], np.arange(n - 1, -1, -1)[None, :]
    v = np.cos((k * (2 * j + 1)) % (4 * n) * (np.pi / (2 * n)))
    return np.where(k == 0, 1.0, 2.0) / n * v


@ft.cache
def _zeros(n: int) -> tuple[np.ndarray, None]:
    """The zeros of T_n, ascending; as a sine, for symmetry."""
    return np.sin(np.arange(1 - n, n, 2) * (np.pi / (2 * n))), None


def _resample(x: Array, grid) -> Array:
    return interpolation_matrix(x, jnp.asarray(grid(x.size)[0], x.dtype))


def _matmul(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def _apply(matrix: Array, values: Array) -> Array:
    return jnp.tensordot(matrix, values, axes=1, precision=jax.lax.Precision.HIGHEST)
