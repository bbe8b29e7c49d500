"""Differentiation, integration and Birkhoff matrices, plain and weighted."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

# The plain matrix is defined beside the barycentric formula, and is offered here with the others.
from jaxguide.spectral.barycentric import Real, as_nodes, interpolation_matrix, like
from jaxguide.spectral.barycentric import barycentric_weights as barycentric_weights
from jaxguide.spectral.barycentric import differentiation_matrix as differentiation_matrix
from jaxguide.spectral.nodes import check_end, nodes_lg
from jaxguide.spectral.transforms import legendre_matrix, legendre_vandermonde

Scalar = Float[Array, ""]


def weighted_differentiation_matrix(
    x: Float[Real, " n"], weight: Callable[[Scalar], Scalar]
) -> Float[Array, "n n"]:
    r"""Derivative at the nodes of the W-weighted interpolant
    $y(t) = \sum_j \frac{W(t)}{W(t_j)} \phi_j(t) y_j$.

    With $W = 1 - t$ on `nodes_lgr(n, "left")` the interpolant vanishes at +1, the image of an
    infinite horizon; with $W = 1 - t^2$ on `nodes_lg(n)`, at both ends. Zeros of W must not be
    nodes.

    **Arguments:** `x`: distinct nodes; `weight`: W, a differentiable scalar function.

    **Returns:** `D` per unit of `x`: $[\dot W(t_i) \delta_{ij} + W(t_i) \hat D_{ij}] / W(t_j)$.

    **Error:** exact on W times a polynomial below degree n, to rounding of order $n^2 \epsilon$
    times the greatest $W(t_i)/W(t_j)$.

    **Raises:** `ValueError` if W is zero at a known node; if traced, columns of inf or NaN.

    **Source:** Ross & Karpenko, review (2012), eqs. (10)-(12).
    """
    x = as_nodes(x)
    w, w_dot = _weight_values(x, weight)
    d = differentiation_matrix(x)
    return w[:, None] * d / w[None, :] + jnp.diag(w_dot / w)


def weighted_quadrature(
    x: Float[Real, " n"], weight: Callable[[Scalar], Scalar]
) -> Float[Array, " n"]:
    r"""Integration weights of the W-weighted interpolant, $\int_{-1}^1 \frac{W}{W_j} \phi_j dt$.

    They integrate W times a polynomial below degree n exactly. On a Gauss grid whose own rule does
    so too (1 - t on LGR, 1 - t^2 on LG) they are its weights.

    **Arguments:** as `weighted_differentiation_matrix`.

    **Returns:** n weights on [-1, 1], in units of `x`.

    **Error:** rounding if W is a polynomial of degree 3 or less, else that of Gauss quadrature
    with n + 1 points.

    **Raises:** `ValueError` if W is zero at a known node.

    **Source:** Ross & Karpenko, review (2012), eqs. (15), (16).
    """
    x = as_nodes(x)
    w, _ = _weight_values(x, weight)
    points, gauss = (jnp.asarray(a, x.dtype) for a in nodes_lg(x.size + 1))
    basis = interpolation_matrix(x, points)
    mass = gauss * jax.vmap(weight)(points)
    return jnp.matmul(mass, basis, precision=jax.lax.Precision.HIGHEST) / w


def integration_matrix(
    x: Float[Real, " n"], start: Float[Real, ""] | float | int = -1.0
) -> Float[Array, "n n"]:
    r"""Matrix with $(B f)_i = \int_{start}^{x_i} p$, $p$ interpolating $(x_j, f_j)$.

    Through Legendre coefficients, integrated by $(2k+1) \int P_k = P_{k+1} - P_{k-1}$.

    **Arguments:** `x`: distinct nodes on [-1, 1]; `start`: lower limit on [-1, 1].

    **Returns:** `B` in units of `x`; times $(t_f - t_0)/2$ gives s. Differentiable in both.

    **Error:** exact below degree n (`p` has degree n - 1), to $n \epsilon$ times the Lebesgue
    constant of the nodes.

    **Raises:** `ValueError` if known nodes coincide.

    **Source:** Canuto et al., Spectral Methods: Single Domains (2006), section 2.3.
    """
    x = as_nodes(x)
    n = x.size
    p = legendre_vandermonde(jnp.concatenate([x, like(start, x).reshape(1)]), n + 1)
    p = p[:-1] - p[-1:]
    lower = jnp.concatenate([jnp.zeros((n, 1), x.dtype), p[:, : n - 1]], axis=1)
    integrals = (p[:, 1:] - lower) / jnp.asarray(2 * np.arange(n)[None, :] + 1, x.dtype)
    return jnp.matmul(integrals, legendre_matrix(x), precision=jax.lax.Precision.HIGHEST)


def birkhoff_matrix(x: Float[Real, " n"], end: str = "left") -> Float[Array, "n n+1"]:
    r"""Birkhoff interpolation: a value at one end and slopes at the nodes, to values at the nodes.

    The polynomial $y$ of degree n with $y(e)$ and $y'(x_j)$ given, e = -1 ("left", the a-form) or
    +1 ("right", the b-form), has $y(x_i) = M_{i0} y(e) + \sum_j M_{i,j+1} y'(x_j)$. So
    M = [1, B], B = `integration_matrix(x, e)`: column 0 is ones. `e` need not be a node.

    **Arguments:** `x`: distinct nodes on [-1, 1]; `end`: where the value is given.

    **Returns:** `M`; column 0 dimensionless, the others in units of `x`.

    **Error:** as `integration_matrix`; unlike $D$, the condition number stays bounded in n.

    **Raises:** `ValueError` if `end` is neither "left" nor "right" or known nodes coincide.

    **Source:** Wang, Samson & Zhao, SIAM J. Sci. Comput. 36 (2014), section 2.
    """
    check_end(end)
    b = integration_matrix(x, -1.0 if end == "left" else 1.0)
    return jnp.concatenate([jnp.ones((b.shape[0], 1), b.dtype), b], axis=1)


def _weight_values(x: Array, weight: Callable) -> tuple[Array, Array]:
    """W and dW/dt at the nodes."""
    w, w_dot = jax.jvp(jax.vmap(weight), (x,), (jnp.ones_like(x),))
    if not isinstance(w, Tracer) and np.any(np.asarray(w) == 0):
        zeros = np.asarray(x)[np.asarray(w) == 0]
        raise ValueError(
            f"weight is zero at the node(s) {zeros}: use nodes that leave them out, such as "
            'nodes_lgr(n, "left") for 1 - t and nodes_lg(n) for 1 - t^2.'
        )
    return w, w_dot
