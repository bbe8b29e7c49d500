r"""The review's problem E2 on Gaussian grids, each one a quadratic program.

$\int_0^1 x_2 u\,dt$ with $\dot x_1 = x_2$, $\dot x_2 = -x_2 + u$, from (0, 1) to (1, 1), x_2 >= 0,
0 <= u <= 2; u = 1 is optimal. With u = x_2' + x_2 the cost is $[x_2^2]/2 + \int x_2^2$, convex as
long as the ends are fixed. If the end conditions hold at a node that is not the end, the end of the
interpolant is free, and at t = 0 its square enters with a minus sign.

**Source:** Ross & Karpenko, review (2012), section 4.2.2.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from jaxguide.reproduce.ps_review.duality import weighted
from jaxguide.reproduce.ps_review.qp import solve_qp
from jaxguide.spectral.grids import grid

HALF = 0.5  # dt/dtau: t in [0, 1], tau in [-1, 1]


class E2Solution(NamedTuple):
    """E2 on one grid.

    - `t`, `u`: at the nodes. `error`: max |u - 1|.
    - `violation`: of the KKT conditions. `curvature`: least eigenvalue of the Hessian on the null
      space of the constraints.
    - `rounding`: eps times the condition number of the KKT matrix.
    - `feasible`: whether any point meets the constraints (by HiGHS).
    """

    t: np.ndarray
    u: np.ndarray
    error: float
    violation: float
    curvature: float
    rounding: float
    feasible: bool


def solve_e2(family: str, points: int, extrapolated: bool = False, weight: str = "1") -> E2Solution:
    """Problem B^N of E2, with the end conditions e(x_0, x_N) at the first and last node, or with
    `extrapolated` at the ends of the interpolant; `weight`: a key of `duality.WEIGHTS`."""
    own = grid(family, points)
    n, eye, zero = points, np.eye(points), np.zeros((points, points))
    d = weighted(own.x, own.differentiation, weight)
    ends = own.ends if extrapolated else eye[[0, -1]]
    none = np.zeros((2, n))
    G = np.block(
        [
            [d, -HALF * eye, zero],
            [zero, d + HALF * eye, -HALF * eye],
            [ends, none, none],
            [none, ends, none],
        ]
    )
    right = np.concatenate([np.zeros(2 * n), [0.0, 1.0, 1.0, 1.0]])
    mass = HALF * np.diag(own.w)
    H = np.block([[zero, zero, zero], [zero, zero, mass], [zero, mass, zero]])
    lower = np.concatenate([np.full(n, -np.inf), np.zeros(2 * n)])
    upper = np.concatenate([np.full(2 * n, np.inf), np.full(n, 2.0)])
    found = solve_qp(H, np.zeros(3 * n), G, right, lower, upper)
    program = linprog(np.zeros(3 * n), A_eq=G, b_eq=right, bounds=np.stack([lower, upper], axis=1))
    free = np.linalg.svd(G)[2][len(G) :].T
    K = np.block([[H, G.T], [G, np.zeros((len(G), len(G)))]])
    u = found.z[2 * n :]
    return E2Solution(
        (own.x + 1) / 2, u, float(np.max(np.abs(u - 1))), found.violation,
        float(np.linalg.eigvalsh(free.T @ H @ free)[0]),
        float(np.finfo(float).eps * np.linalg.cond(K)), program.status == 0,
    )  # fmt: skip
