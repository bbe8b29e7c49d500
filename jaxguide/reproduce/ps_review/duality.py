r"""Which weights W, W* pair with which grid: the discrete integration by parts behind the review's
Table 1.

With an exact quadrature w, integrating $\int W^* \phi_i \phi_j'/W^*_i$ by parts gives

    $w_i D_{ij} + w_j D^*_{ji} = \delta_{i,+1} \delta_{ij} - \delta_{i,-1} \delta_{ij}$

with $\delta_{i,\pm 1} = 1$ if node i is that end, where the value of W* does not matter. So W* must
vanish at an end that is not a node: the costate vanishes there, which means that the state is free.
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
    """The weighted differentiation matrix in NumPy, from the plain matrix `d` of the nodes `x`; a
    test holds it to the library's `weighted_differentiation_matrix`.

    **Source:** Ross & Karpenko, review (2012), eq. (12).
    """
    W, rate = WEIGHTS[weight]
    return W(x)[:, None] * d / W(x)[None] + np.diag(rate(x) / W(x))


def by_parts_defect(family: str, weight: str, points: int) -> float:
    """Greatest violation of this module's identity, with W = 1 for the state and W* = `weight`."""
    own = grid(family, points)
    ends = np.diag((own.x == 1.0).astype(float) - (own.x == -1.0))
    dual = weighted(own.x, own.differentiation, weight)
    parts = own.w[:, None] * own.differentiation + (own.w[:, None] * dual).T
    return float(np.max(np.abs(parts - ends)))


def mapping_matrix(family: str, weight: str, points: int) -> tuple[np.ndarray, float]:
    r"""P of the review's Proposition 1, $\Lambda = P \tilde\Lambda$, column by column, from
    solutions alone.

    Minimise $\int ((x - r)^2 + u^2)/2$ with $\dot x = t x + u$ and, where -1 is a node, x(-1)
    fixed. For each unit vector, r is chosen so that the multipliers of B^N are that vector; the
    column is the costate of problem B^{lambda N} for that r, with D* of W* = `weight`.

    **Returns:** P, and the rounding of its entries: eps times the condition numbers of both solves
    and the size of 1/w.
    """
    own = grid(family, points)
    x, w, d, n = own.x, own.w, own.differentiation, points
    f = d - np.diag(x)  # B^N: f X = U; multipliers M of f X - U
    M = np.eye(n)
    u = M / w[:, None]  # w u - M = 0
    states = np.linalg.solve(f, u)
    r = states + f.T @ M / w[:, None]  # w (x - r) + f^T M = 0, no force at a fixed start

    # Where the start is fixed, problem B^N does not impose the costate equation there.
    held = np.flatnonzero(x == -1.0)
    rows = np.delete(np.arange(n), held)
    dual = weighted(x, d, weight) + np.diag(x)
    system = np.block(
        [
            [f, np.eye(n)],  # u = -lambda
            [np.eye(n)[rows], dual[rows]],
            [np.eye(n)[held], np.zeros((len(held), n))],
        ]
    )
    right = np.concatenate([np.zeros((n, n)), r[rows], states[held]])
    solves = np.linalg.cond(f) * np.linalg.cond(system)
    rounding = float(np.finfo(float).eps * solves / np.min(w))
    return np.linalg.solve(system, right)[n:], rounding
