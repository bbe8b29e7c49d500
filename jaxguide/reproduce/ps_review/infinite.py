r"""An infinite horizon: Radau nodes, W = 1 - tau, the bilinear map of the review's eq. (6).

Minimise $\int_0^\infty (x^2 + u^2)\,dt$ with $\dot x = x + u$, x(0) = 1. The value
is $P x^2$ with $2P - P^2 + 1 = 0$: $J = 1 + \sqrt 2$, and $u = -P x$. NumPy only.
"""

import numpy as np

from jaxguide.reproduce.ps_review.duality import weighted
from jaxguide.spectral.grids import grid

VALUE = 1 + np.sqrt(2)  # of J


def regulator_cost(points: int, weight: str = "1-t") -> float:
    """J of the discretised problem, by least squares: no multiplier is needed.

    The dynamics give u_i at each node (dt/dtau = 2/(1-tau)^2), and J is a sum of squares of
    expressions linear in x_1 ... x_N. `weight`: W, a key of `duality.WEIGHTS`.
    """
    own = grid("lgr-left", points)
    rate = 2 / (1 - own.x) ** 2
    control = weighted(own.x, own.differentiation, weight) / rate[:, None] - np.eye(points)
    scale = np.sqrt(own.w * rate)[:, None]
    rows = np.concatenate([scale * np.eye(points), scale * control])
    z = np.linalg.lstsq(rows[:, 1:], -rows[:, 0], rcond=None)[0]
    return float(np.sum((rows[:, 0] + rows[:, 1:] @ z) ** 2))
