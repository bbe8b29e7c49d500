"""Extremes of polynomials between the points at which they are known."""

import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.spectral.grids import differentiation


def extremes_near(
    points: np.ndarray, values: Float[Array, "segment point k"]
) -> tuple[Float[Array, "segment point k"], Float[Array, "segment point k"]]:
    """The least and the largest value of the polynomials through `values` near each of `points`:
    there, or at the vertex of the parabola that touches the polynomial there, if it is no further
    than the next point.

    **Arguments:** `points`: distinct, ascending, on [-1, 1] (dimensionless).

    **Error:** of a vertex at distance d, the third derivative times d^3/6.
    """
    slope = differentiation(points)
    ends = np.concatenate([[-1.0], points, [1.0]])
    behind, ahead = np.diff(ends)[None, :-1, None], np.diff(ends)[None, 1:, None]
    first = xp.einsum("qp,spk->sqk", slope, values)
    second = xp.einsum("qp,spk->sqk", slope @ slope, values)
    step = -first / xp.where(second == 0, 1.0, second)
    vertex = xp.where((step > -behind) & (step < ahead), values + first * step / 2, values)
    least = xp.where(second > 0, xp.minimum(values, vertex), values)
    return least, xp.where(second < 0, xp.maximum(values, vertex), values)
