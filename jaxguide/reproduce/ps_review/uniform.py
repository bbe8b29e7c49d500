r"""The review's problem E1: minimise x(2) with $\dot x = u$, x(0) = 0, u >= -1, on uniform grids
and on LGL.

Discretised it is a linear program: D X = u at all n nodes, x_0 = 0. With v such that v^T D = 0,
D X = u has a solution if and only if v^T u = 0, and then x_N = w^T u with w of eq. (16): it is

    minimise w^T u  subject to  v^T u = 0,  u >= -1.

Its dual has one unknown, gamma. The program is bounded if and only if some gamma has
w_i >= gamma v_i for all i, and u = -1 is its only solution if w_i > gamma v_i. Positive weights
suffice (gamma = 0) but are not necessary.

**Source:** Ross & Karpenko, review (2012), section 4.2.2.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog

from jaxguide.spectral import nodes_lg, nodes_lgl
from jaxguide.spectral.grids import capacity_weights, differentiation, evaluation


class E1Solution(NamedTuple):
    """E1 on one grid.

    - `x`, `w`: nodes on [-1, 1], and weights. `gamma`: ends of the dual's interval, which is empty
      if they descend.
    - `u`: the control found by HiGHS; None where the program is `unbounded`.
    """

    x: np.ndarray
    w: np.ndarray
    gamma: tuple[float, float]
    u: np.ndarray | None
    unbounded: bool

    @property
    def bounded_by_dual(self) -> bool:
        """Whether some gamma is feasible in the dual."""
        return self.gamma[0] <= self.gamma[1]


def interpolatory_weights(x: np.ndarray) -> np.ndarray:
    """Quadrature weights of any distinct nodes: review, eq. (16), with W = 1."""
    points, w = nodes_lg(len(x))
    return w @ evaluation(x, points)


def dual_interval(x: np.ndarray, w: np.ndarray) -> tuple[float, float]:
    """The least and greatest gamma with w >= gamma v, v scaled so that its last entry is w's.

    v are the barycentric weights: v^T u is the divided difference of order N of u, whose
    interpolant has degree N - 1. On LGL v = w P_N.
    """
    v = capacity_weights(x)
    v = v * (w[-1] / v[-1])
    ratio = w / v
    return float(np.max(ratio[v < 0])), float(np.min(ratio[v > 0]))


def condition(x: np.ndarray) -> float:
    """By how much, at worst, v^T u = 0 amplifies rounding in the entry of u that it determines."""
    v = np.abs(capacity_weights(x))
    return float(np.sum(v) / np.min(v))


def program(x: np.ndarray, upper: float | None = None) -> Any:
    """E1 as a linear program in X and u, solved by HiGHS (status 0: solved, 3: unbounded); `upper`:
    a bound of u besides."""
    n = len(x)
    cost = np.concatenate([np.eye(n)[-1], np.zeros(n)])
    rows = np.block([[differentiation(x), -np.eye(n)], [np.eye(1, n), np.zeros((1, n))]])
    bounds = [(None, None)] * n + [(-1.0, upper)] * n
    return linprog(cost, A_eq=rows, b_eq=np.zeros(n + 1), bounds=bounds, method="highs")


def solve_e1(points: int) -> E1Solution:
    """E1 on `points` uniform points; t in [0, 2] and tau in [-1, 1], so dt/dtau = 1."""
    x = np.linspace(-1.0, 1.0, points)
    w = interpolatory_weights(x)
    found = program(x)
    u = None if found.x is None else found.x[points:]
    return E1Solution(x, w, dual_interval(x, w), u, found.status == 3)


def lobatto_costate(points: int) -> tuple[np.ndarray, np.ndarray]:
    """E1 on LGL: multipliers over weights, before and after the closure condition lambda(2) = 1.

    The multipliers over weights are 1 + gamma P_N, with whichever gamma of the dual's interval the
    simplex method ends at; the closure condition leaves gamma = 0.
    """
    x, w = nodes_lgl(points)
    n = points
    raw = program(x).eqlin.marginals[:n] / w
    last = np.polynomial.legendre.legval(x, np.eye(n)[-1])
    return raw, raw - (raw[-1] - 1) * last
