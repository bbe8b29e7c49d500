"""The covector mapping principle in numbers: Ross & Karpenko, review (2012), figure 6, eqs.
(23)-(25), Proposition 1, Remark 3."""

from typing import NamedTuple

import numpy as np

from jaxguide.nominal.direct.collocation import Collocation, collocation, left_null
from jaxguide.reproduce.ps_review.lq import Tracking, discretise, end_rows
from jaxguide.spectral.grids import evaluation

FREQUENCY, PHASE = 3.0, 0.4  # of x_1: half an oscillation on [-1, 1], no symmetry


def oscillator() -> Tracking:
    r"""$\dot x_1 = x_2,\ \dot x_2 = -t x_1 + u$ with the target r for which $x_1 = \sin(kt + c)$ is
    optimal.

    Written backwards: u from the second equation, $\lambda_2 = -u$, $\lambda_1$ and $r_2 = x_2$
    from $\dot\lambda_2 = -\lambda_1$, $r_1$ from $\dot\lambda_1 = -(x_1 - r_1) + t \lambda_2$. Its
    Jacobian is not constant (Proposition 1), and u does not show $\lambda_1$.
    """
    k, c = FREQUENCY, PHASE
    s, o = lambda t: np.sin(k * t + c), lambda t: np.cos(k * t + c)
    state = lambda t: np.stack([s(t), k * o(t)], axis=1)
    control = lambda t: (t - k**2) * s(t)
    costate = lambda t: np.stack([s(t) + (t - k**2) * k * o(t), (k**2 - t) * s(t)], axis=1)
    rate = lambda t: 2 * k * o(t) - (t - k**2) * k**2 * s(t)  # of the first costate
    target = lambda t: np.stack([s(t) + rate(t) - t * (k**2 - t) * s(t), k * o(t)], axis=1)

    def a(t: np.ndarray) -> np.ndarray:
        zero, one = np.zeros_like(t), np.ones_like(t)
        return np.stack([np.stack([zero, one], 1), np.stack([-t, zero], 1)], axis=1)

    p = costate(np.array([1.0]))[0]
    return Tracking(a, np.array([0.0, 1.0]), target, state, control, costate, p)


class Errors(NamedTuple):
    """Greatest errors of the costate at the nodes, relative to its greatest value.

    - `raw`: of multipliers over weights. `closed`: the same without the null mode (LGL only).
    - `dual`: of the collocated necessary conditions. `gap`: between `closed` and `dual`.
    - `mode`: the multiple of P_N that was subtracted. `closure`: miss of both closure conditions
      after that.
    - `consistency`: residual of the dual problem where it has more equations than unknowns.
    """

    raw: float
    closed: float
    dual: float
    gap: float
    mode: float
    closure: float
    consistency: float


def errors(family: str, points: int) -> Errors:
    """Errors of the costate both ways around the diagram of the review's figure 6, on one grid."""
    problem = oscillator()
    rule = collocation(family, points)
    ends = end_rows(rule, extrapolated=True)
    found = discretise(rule, problem, ends)
    raw = -(rule.B.T @ found.defect) / rule.w[:, None]  # Remark 3, P = diag(1/w)
    wanted = np.stack([-found.end[0], problem.end_cost])  # B^lambda: lambda at both ends
    closed, mode = closed_costate(rule, family, raw, wanted)
    at_ends = evaluation(rule.nodes, np.array([-1.0, 1.0])) @ closed
    dual, consistency = dualised(rule, problem)
    exact = problem.costate(rule.nodes)
    size = np.max(np.abs(exact))
    off = lambda y, z=exact: float(np.max(np.abs(y - z)) / size)
    return Errors(
        off(raw), off(closed), off(dual), off(closed, dual), float(np.max(np.abs(mode))),
        off(at_ends, wanted), consistency,
    )  # fmt: skip


def closed_costate(
    rule: Collocation, family: str, raw: np.ndarray, wanted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`raw` less the multiple of P_N that the closure conditions determine, and that multiple; zero
    on grids without a null mode.

    **Arguments:** `wanted` (2, n): the costate at both ends.
    """
    if not len(rule.extra):
        return raw, np.zeros(raw.shape[1])
    v = left_null(family, len(rule.nodes)) / rule.w
    v = v / v[-1]  # P_N
    mode = ((raw[0] - wanted[0]) / v[0] + (raw[-1] - wanted[1]) / v[-1]) / 2
    return raw - np.outer(v, mode), mode


def dualised(rule: Collocation, problem: Tracking) -> tuple[np.ndarray, float]:
    """Dualise, then discretise: x and lambda collocated on the same grid, u = -b^T lambda.

    On LGL there are more equations than unknowns. They are solved by least squares; the residual is
    the delta^N by which problem B^{lambda N} is relaxed.

    **Returns:** lambda at the nodes, and the largest residual.
    """
    n, P, C = len(problem.b), len(rule.support), len(rule.nodes)
    a, eye = problem.a(rule.nodes), np.eye(n)
    at_nodes = np.eye(P)[rule.first : rule.first + C]
    slope = np.einsum("rp,ij->ripj", rule.A, eye).reshape(-1, P * n)
    spread = lambda m: np.einsum("rc,cij,cp->ripj", rule.B, m, at_nodes).reshape(-1, P * n)
    b = np.tile(np.outer(problem.b, problem.b), (C, 1, 1))
    ends = np.kron(end_rows(rule, extrapolated=True), eye)
    zero = np.zeros((n, P * n))
    M = np.block(
        [
            [slope - spread(a), spread(b)],
            [spread(np.tile(eye, (C, 1, 1))), slope + spread(np.swapaxes(a, 1, 2))],
            [ends[:n], zero],
            [zero, ends[n:]],
        ]
    )
    right = [
        np.zeros(len(rule.A) * n),
        (rule.B @ problem.target(rule.nodes)).reshape(-1),
        problem.end(0),
        problem.end_cost,
    ]
    right = np.concatenate(right)
    z = np.linalg.lstsq(M, right, rcond=None)[0]
    lam = z[P * n :].reshape(P, n)
    return at_nodes @ lam, float(np.max(np.abs(M @ z - right)))
