"""Weighted interpolants, Ross & Karpenko, review (2012), eqs. (10)-(16), by the library's own
matrices."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.spectral import (
    nodes_lgr,
    weighted_differentiation_matrix,
    weighted_quadrature,
)
from jaxguide.spectral.grids import evaluation

# One program for each shape, not one for each operation.
_matrix = jax.jit(weighted_differentiation_matrix, static_argnums=1)
_quadrature = jax.jit(weighted_quadrature, static_argnums=1)

# An arbitrary grid of 8 points (the paper prints none); no end is a node, so any W of Table 1 will
# do.
ARBITRARY = np.array([-0.93, -0.66, -0.41, -0.02, 0.23, 0.49, 0.71, 0.9])
CHOSEN = 2  # the basis function of the review's figures 4 and 5


def decaying(t: jax.Array) -> jax.Array:
    """W = 1 - t, which vanishes at +1."""
    return 1 - t


def constant(t: jax.Array) -> jax.Array:
    """W = 1."""
    return jnp.ones_like(t)


def basis(query: np.ndarray, weighted: bool) -> np.ndarray:
    """W(t)/W(t_j) phi_j(t) at the points `query`, shape (q, n), on the arbitrary grid; W = 1 - t if
    `weighted`, else 1."""
    out = evaluation(ARBITRARY, query)
    return out * (1 - query[:, None]) / (1 - ARBITRARY) if weighted else out


def matrix_defects() -> dict[str, float]:
    """Errors of the library's matrices against the review's eqs. (11), (12) and (16), by name, on
    the grid ARBITRARY."""
    x, n = ARBITRARY, len(ARBITRARY)
    D = np.asarray(_matrix(x, decaying))
    plain = np.asarray(_matrix(x, constant))
    w = np.asarray(_quadrature(x, decaying))
    powers = np.arange(n)
    y = (1 - x[:, None]) * x[:, None] ** powers  # W times t^k, k < n
    slope = -(x[:, None] ** powers) + (1 - x[:, None]) * powers * x[:, None] ** np.maximum(
        powers - 1, 0
    )
    integral = (1 + (-1.0) ** powers) / (powers + 1) - (1 - (-1.0) ** powers) / (powers + 2)
    return {
        "Kronecker": float(np.max(np.abs(basis(x, True) - np.eye(n)))),
        "derivative": float(np.max(np.abs(D @ y - slope))),
        "integral": float(np.max(np.abs(w @ y - integral))),
        "constants, W = 1": float(np.max(np.abs(plain @ np.ones(n)))),
        "constants, W = 1 - t": float(np.max(np.abs(D @ np.ones(n)))),
        "slope, W = 1": float(plain[CHOSEN, CHOSEN]),
        "slope, W = 1 - t": float(D[CHOSEN, CHOSEN]),
        "shift": float(-1 / (1 - x[CHOSEN])),
    }


def radau_weights(points: int) -> float:
    """max |w - Radau weights|, with w of the review's eq. (16) for W = 1 - t."""
    x, gauss = nodes_lgr(points)
    return float(np.max(np.abs(np.asarray(_quadrature(x, decaying)) - gauss)))


def decay(points: int) -> tuple[float, float]:
    r"""Error of the derivative of $(1 - \tau) / (5 - \tau)$, which vanishes at +1, for W = 1 - t
    and W = 1."""
    x, _ = nodes_lgr(points)
    y, slope = (1 - x) / (5 - x), -4 / (5 - x) ** 2
    off = lambda weight: float(np.max(np.abs(np.asarray(_matrix(x, weight)) @ y - slope)))
    return off(decaying), off(constant)
