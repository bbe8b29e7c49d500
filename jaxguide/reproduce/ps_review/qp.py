"""Quadratic programs of a few dozen unknowns between bounds. NumPy only."""

from typing import NamedTuple

import numpy as np


class Solution(NamedTuple):
    """Point, multipliers of the equalities and of the bounds (<= 0 at lower, >= 0 at upper), and
    the largest violation of the first-order conditions."""

    z: np.ndarray
    y: np.ndarray
    bound: np.ndarray
    violation: float


def minimise(
    H: np.ndarray, cost: np.ndarray, G: np.ndarray, right: np.ndarray, lower: np.ndarray,
    upper: np.ndarray, iterations: int = 100,
) -> Solution:  # fmt: skip
    r"""A KKT point of z^T H z / 2 + cost^T z with G z = right and lower <= z <= upper.

    Primal-dual active set: guess which bounds hold, solve the linear system exactly, guess anew.
    It ends at a KKT point or not at all; a minimum if H is convex on the null space of G.

    **Error:** that of one dense solve; it is in `violation`, which is of order 1 where it failed.

    **Source:** Hintermueller, Ito & Kunisch, SIAM J. Optim. 13 (2002), section 2.
    """
    active = np.zeros(len(cost), int)  # -1 at lower, 1 at upper
    z, y, bound = _on(active, H, cost, G, right, lower, upper)
    for _ in range(iterations):
        guess = np.where(bound + z - upper > 1e-12, 1, np.where(bound + z - lower < -1e-12, -1, 0))
        if np.array_equal(guess, active):
            break
        active = guess
        z, y, bound = _on(active, H, cost, G, right, lower, upper)
    slope = np.abs(H @ z + cost + G.T @ y + bound)
    outside = np.maximum(np.maximum(lower - z, z - upper), 0.0)
    wrong = np.maximum(-bound * (active > 0), bound * (active < 0))
    parts = (np.abs(G @ z - right), slope, outside, wrong)
    return Solution(z, y, bound, float(max(np.max(part, initial=0.0) for part in parts)))


def _on(
    active: np.ndarray, H: np.ndarray, cost: np.ndarray, G: np.ndarray, right: np.ndarray,
    lower: np.ndarray, upper: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """The stationary point where the active bounds hold as equalities: z, y, bound multipliers."""
    free, m = active == 0, len(right)
    z = np.where(active < 0, lower, np.where(active > 0, upper, 0.0))
    E, F = G[:, free], H[np.ix_(free, free)]
    K = np.block([[F, E.T], [E, np.zeros((m, m))]])
    known = np.concatenate([-cost[free] - H[free] @ z, right - G @ z])
    s = np.linalg.lstsq(K, known, rcond=1e-13)[0]  # active rows may leave too few unknowns
    z[free], y = s[: free.sum()], s[free.sum() :]
    return z, y, np.where(free, 0.0, -(H @ z + cost + G.T @ y))
