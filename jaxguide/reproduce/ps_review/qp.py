"""Quadratic programs of a few dozen unknowns between bounds. NumPy only."""

from typing import NamedTuple

import numpy as np

_ON = 1e-12  # slack of a bound that counts as active: rounding of unknowns of order 1


class QPSolution(NamedTuple):
    """A KKT point of a quadratic program.

    - `z`: the point. `y`: multipliers of the equalities. `bound`: those of the bounds (<= 0 at
      lower, >= 0 at upper ones).
    - `violation`: the largest, of all first-order conditions.
    """

    z: np.ndarray
    y: np.ndarray
    bound: np.ndarray
    violation: float


def solve_qp(
    H: np.ndarray, cost: np.ndarray, G: np.ndarray, right: np.ndarray, lower: np.ndarray,
    upper: np.ndarray, iterations: int = 100,
) -> QPSolution:  # fmt: skip
    r"""A KKT point of z^T H z / 2 + cost^T z with G z = right and lower <= z <= upper.

    Primal-dual active set: guess which bounds are active, solve the linear system exactly, and let
    the signs of the result make the next guess. A guess that repeats is a KKT point; it is a
    minimum if H is convex on the null space of G.

    **Error:** that of one dense solve. `violation` holds it, and is of order 1 if the guesses have
    not settled within `iterations`.

    **Source:** Hintermueller, Ito & Kunisch, SIAM J. Optim. 13 (2002), section 2.
    """
    active = np.zeros(len(cost), int)  # -1 at lower, 1 at upper
    z, y, bound = _on(active, H, cost, G, right, lower, upper)
    for _ in range(iterations):
        high, low = bound + z - upper > _ON, bound + z - lower < -_ON
        guess = np.where(high, 1, np.where(low, -1, 0))
        if np.array_equal(guess, active):
            break
        active = guess
        z, y, bound = _on(active, H, cost, G, right, lower, upper)
    slope = np.abs(H @ z + cost + G.T @ y + bound)
    outside = np.maximum(np.maximum(lower - z, z - upper), 0.0)
    wrong = np.maximum(-bound * (active > 0), bound * (active < 0))
    parts = (np.abs(G @ z - right), slope, outside, wrong)
    return QPSolution(z, y, bound, float(max(np.max(part, initial=0.0) for part in parts)))


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
    # Least squares: active bounds may leave too few unknowns. 1e-13: rounding of such matrices.
    s = np.linalg.lstsq(K, known, rcond=1e-13)[0]
    z[free], y = s[: free.sum()], s[free.sum() :]
    return z, y, np.where(free, 0.0, -(H @ z + cost + G.T @ y))
