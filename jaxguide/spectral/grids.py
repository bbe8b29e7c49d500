"""Standard grids with their matrices: host-side NumPy constants, cached, for use under `jit`."""

import functools as ft
from typing import NamedTuple

import numpy as np

from jaxguide.spectral.families import NodeFamily, checked_nodes, node_family
from jaxguide.spectral.nodes import nodes_lg


class Grid(NamedTuple):
    """Constants of n nodes of a family, read-only float64; tau on [-1, 1], dimensionless.

    - `x`, `w` (n,): nodes and quadrature weights.
    - `differentiation`, `integration` (n, n): as `differentiation_matrix` and `integration_matrix`
      from -1.
    - `ends` (2, n): evaluates the interpolant at -1 and +1.
    """

    x: np.ndarray
    w: np.ndarray
    differentiation: np.ndarray
    integration: np.ndarray
    ends: np.ndarray


@ft.cache
def grid(family: str | NodeFamily, n: int) -> Grid:
    """Nodes, weights and matrices of `n` points.

    Written in NumPy beside the JAX versions (tests hold them equal) so that the constants are
    float64 whatever JAX is set to, and are no part of the compiled program.

    **Arguments:** `family`: "lg", "lgl", "cgl", "lgr-left", "lgr-right" or a `NodeFamily`; `n`:
    number of points.

    **Returns:** a `Grid`; cast it to the dtype in use.

    **Error:** that of `differentiation_matrix` and `integration_matrix`.

    **Raises:** `ValueError` for another family, too few points, or nodes that break the contract
    of `NodeFamily`.

    **Source:** that of `differentiation_matrix` and `integration_matrix`.
    """
    x, w = checked_nodes(node_family(family), n)
    weights = capacity_weights(x)
    d = differentiation(x, weights)

    k = np.arange(n)
    p = np.polynomial.legendre.legvander(x, n) - (-1.0) ** np.arange(n + 1)
    lower = np.concatenate([np.zeros((n, 1)), p[:, : n - 1]], axis=1)
    b = (p[:, 1:] - lower) / (2 * k + 1) @ legendre(x, weights)
    out = Grid(x, w, d, b, evaluation(x, np.array([-1.0, 1.0]), weights))
    for a in out:
        a.flags.writeable = False
    return out


def legendre(x: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """From values at the nodes `x` to the Legendre coefficients of their interpolant; see
    `legendre_matrix`."""
    points, gauss = nodes_lg(len(x))
    k = np.arange(len(x))
    project = (k[:, None] + 0.5) * np.polynomial.legendre.legvander(points, len(x) - 1).T * gauss
    return project @ evaluation(x, points, weights)


def capacity_weights(x: np.ndarray) -> np.ndarray:
    """Barycentric weights (n,) of distinct nodes on [-1, 1], in NumPy.

    Factors are scaled by 2, the inverse capacity of [-1, 1]; in this order their products stay
    within float64 past n = 512.

    **Source:** Berrut & Trefethen, SIAM Review 46 (2004), eq. (3.2) and section 7.
    """
    return 1 / np.prod((x[:, None] - x[None, :] + np.eye(len(x)) / 2) * 2, axis=1)


def differentiation(x: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """The differentiation matrix (n, n) of distinct nodes `x`, in NumPy.

    **Arguments:** `weights`: barycentric weights of `x`, if at hand.

    **Error, Source:** that of `differentiation_matrix`.
    """
    weights = capacity_weights(x) if weights is None else weights
    eye = np.eye(len(x))
    d = (weights[None, :] / weights[:, None] - eye) / (x[:, None] - x[None, :] + eye)
    return d - np.diag(d.sum(axis=1))


def evaluation(x: np.ndarray, query: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Matrix (q, n) that evaluates the interpolant through distinct nodes `x` at `query`, in NumPy.

    **Arguments:** `weights`: barycentric weights of `x`, if at hand.

    **Error, Source:** that of `interpolation_matrix`.
    """
    weights = capacity_weights(x) if weights is None else weights
    dx = query[:, None] - x[None, :]
    hit = dx == 0
    terms = weights[None, :] / np.where(hit, 1.0, dx)
    terms = np.where(hit.any(axis=1, keepdims=True), hit, terms)
    return terms / terms.sum(axis=1, keepdims=True)
