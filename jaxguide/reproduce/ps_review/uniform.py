r"""Problem E1: minimise x(2) with $\dot x = u$, x(0) = 0, u >= -1, on uniform grids and on LGL.

Discretised it is a linear program: D X = u at all n nodes, x_0 = 0. Since D X = u can be solved if
and only if v^T u = 0, v^T D = 0, and then x_N = w^T u with w of eq. (16), it is

    minimise w^T u  subject to  v^T u = 0,  u >= -1.

Its dual has one unknown: bounded if and only if w_i >= gamma v_i for all i with one gamma; and
u = -1 is the only solution if w_i > gamma v_i. Positive weights, gamma = 0, suffice; they are not
necessary.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog

from jaxguide.spectral import nodes_lg, nodes_lgl
from jaxguide.spectral.grids import capacity_weights, differentiation, evaluation


class Uniform(NamedTuple):
    """E1 on the grid `x`, on [-1, 1]; `gamma`: ends of the dual interval, empty if descending."""

    x: np.ndarray
    w: np.ndarray
    gamma: tuple[float, float]
    u: np.ndarray | None
    unbounded: bool

    @property
    def bounded_by_dual(self) -> bool:
        return self.gamma[0] <= self.gamma[1]


def interpolatory_weights(x: np.ndarray) -> np.ndarray:
    """Eq. (16) with W = 1, of any distinct nodes."""
    points, w = nodes_lg(len(x))
    return w @ evaluation(x, points)


def dual_interval(x: np.ndarray, w: np.ndarray) -> tuple[float, float]:
    """The gammas with w >= gamma v, v scaled so that its last entry is that of w.

    v are the barycentric weights: v^T u is the divided difference of order N of u, whose
    interpolant has degree N - 1. On LGL v = w P_N.
    """
    v = capacity_weights(x)
    v = v * (w[-1] / v[-1])
    ratio = w / v
    return float(np.max(ratio[v < 0])), float(np.min(ratio[v > 0]))


def condition(x: np.ndarray) -> float:
    """How v^T u = 0 amplifies rounding in the one entry of u that it determines, at worst."""
    v = np.abs(capacity_weights(x))
    return float(np.sum(v) / np.min(v))


def program(x: np.ndarray, upper: float | None = None) -> Any:
    """The linear program as it stands, in X and u, by HiGHS: status 0 solved, 3 unbounded."""
    n = len(x)
    cost = np.concatenate([np.eye(n)[-1], np.zeros(n)])
    rows = np.block([[differentiation(x), -np.eye(n)], [np.eye(1, n), np.zeros((1, n))]])
    bounds = [(None, None)] * n + [(-1.0, upper)] * n
    return linprog(cost, A_eq=rows, b_eq=np.zeros(n + 1), bounds=bounds, method="highs")


def solve(points: int) -> Uniform:
    """E1 on `points` uniform points; 2 of t are 2 of tau, so dt/dtau = 1."""
    x = np.linspace(-1.0, 1.0, points)
    w = interpolatory_weights(x)
    found = program(x)
    u = None if found.x is None else found.x[points:]
    return Uniform(x, w, dual_interval(x, w), u, found.status == 3)


def lobatto_costate(points: int) -> tuple[np.ndarray, np.ndarray]:
    """E1 on LGL: multipliers over weights, which are 1 + gamma P_N with any gamma of the dual
    interval, as the simplex method leaves them; and the same less the gamma that the closure
    condition lambda(2) = 1 does not allow."""
    x, w = nodes_lgl(points)
    n = points
    raw = program(x).eqlin.marginals[:n] / w
    last = np.polynomial.legendre.legval(x, np.eye(n)[-1])
    return raw, raw - (raw[-1] - 1) * last
