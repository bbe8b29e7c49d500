r"""Which weights W, W* pair with which grid: the discrete integration by parts behind Table 1.

With quadrature w that is exact, $\int W^* \phi_i \phi_j'/W^*_i$ by parts reads

    $w_i D_{ij} + w_j D^*_{ji} = \delta_{i,+1} \delta_{ij} - \delta_{i,-1} \delta_{ij}$

with $\delta_{i,\pm 1}$ marking a node at that end, where W* has no say. So an end that is no node
must be one where W* = 0: the costate vanishes there, which is to say that the state is free.
"""

from collections.abc import Callable

import numpy as np

from jaxguide.spectral.grids import grid

# W and its derivative, by the name they have in Table 1.
WEIGHTS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]]
WEIGHTS = {
    "1": (np.ones_like, np.zeros_like),
    "1-t": (lambda t: 1 - t, lambda t: -np.ones_like(t)),
    "1-t^2": (lambda t: 1 - t**2, lambda t: -2 * t),
}


def weighted(x: np.ndarray, d: np.ndarray, weight: str) -> np.ndarray:
    """Eq. (12) in NumPy, from the plain matrix `d` of nodes `x`; a test holds it to the library's
    `weighted_differentiation_matrix`."""
    W, rate = WEIGHTS[weight]
    return W(x)[:, None] * d / W(x)[None] + np.diag(rate(x) / W(x))


def by_parts_defect(family: str, weight: str, points: int) -> float:
    """Greatest violation of the identity above, with W = 1 for the state and W* = `weight`."""
    own = grid(family, points)
    ends = np.diag((own.x == 1.0).astype(float) - (own.x == -1.0))
    dual = weighted(own.x, own.differentiation, weight)
    parts = own.w[:, None] * own.differentiation + (own.w[:, None] * dual).T
    return float(np.max(np.abs(parts - ends)))


def mapping_matrix(family: str, weight: str, points: int) -> np.ndarray:
    r"""Proposition 1: P with $\Lambda = P \tilde\Lambda$, found from solutions alone.

    Minimise $\int ((x - r)^2 + u^2)/2$ with $\dot x = t x + u$ for 3n random r and, where -1 is a
    node, starts x(-1). Multipliers of B^N on one side, costates of problem B^{lambda N} with D* of
    W* = `weight` on the other.
    """
    own = grid(family, points)
    x, w, d, n = own.x, own.w, own.differentiation, points
    held = np.flatnonzero(x == -1.0)
    rng = np.random.default_rng(0)
    r, start = rng.normal(size=(n, 3 * n)), rng.normal(size=(len(held), 3 * n))
    G = np.block([[d - np.diag(x), -np.eye(n)], [np.eye(n)[held], np.zeros((len(held), n))]])
    m = len(G)
    K = np.block([[np.diag(np.r_[w, w]), G.T], [G, np.zeros((m, m))]])
    right = np.concatenate([w[:, None] * r, np.zeros((2 * n, 3 * n)), start])
    multipliers = np.linalg.solve(K, right)[2 * n : 3 * n]

    # Where the start is fixed, the costate equation there is what B^N does not impose.
    dual = weighted(x, d, weight)
    rows = np.delete(np.arange(n), held)
    M = np.block(
        [
            [d - np.diag(x), np.eye(n)],  # u = -lambda
            [np.eye(n)[rows], (dual + np.diag(x))[rows]],
            [np.eye(n)[held], np.zeros((len(held), n))],
        ]
    )
    found = np.linalg.solve(M, np.concatenate([np.zeros((n, 3 * n)), r[rows], start]))
    return np.linalg.lstsq(multipliers.T, found[n:].T, rcond=None)[0].T
