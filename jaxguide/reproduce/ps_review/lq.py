"""Linear-quadratic problems on one segment: the review's problem B^N as one linear system.

Time is tau on [-1, 1]; cost and costate are mapped as in Ross & Karpenko, review (2012), section
4.1. NumPy only.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxguide.nominal.direct.collocation import Collocation
from jaxguide.spectral.grids import evaluation, grid

Function = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Tracking:
    r"""Minimise $\int_{-1}^1 (|x - r|^2 + u^2)/2\,dt + p^T x(1)$ with $\dot x = a(t) x + b u$.

    **Arguments:**

    - `a`: from k times to (k, n, n). `b`: (n,). `target`: r, from k times to (k, n).
    - `state`, `control`, `costate`: the solution, from k times to (k, n), (k,), (k, n).
    - `end_cost`: p (n,).
    - `fixed`: whether x(-1) and x(1) are fixed at the solution's.
    """

    a: Function
    b: np.ndarray
    target: Function
    state: Function
    control: Function
    costate: Function
    end_cost: np.ndarray
    fixed: tuple[bool, bool] = (True, False)

    def end(self, i: int) -> np.ndarray:
        """The solution's state at -1 (`i` = 0) or 1 (`i` = 1)."""
        return self.state(np.array([(-1.0, 1.0)[i]]))[0]


class Discrete(NamedTuple):
    """A stationary point of B^N: states at P support points, controls at C nodes, multipliers of R
    defects and of the two end conditions (zero where free)."""

    x: np.ndarray
    u: np.ndarray
    defect: np.ndarray
    end: np.ndarray


def review_grid(family: str, points: int) -> Collocation:
    """The review's own problem B^N, eq. (21): state, control and dynamics at every node, and at no
    other point, whichever ends are nodes."""
    own = grid(family, points)
    rows, eye = np.arange(points), np.eye(points)
    return Collocation(own.x, own.x, 0, own.w, own.differentiation, eye, rows, rows[:0])


def end_rows(rule: Collocation, extrapolated: bool) -> np.ndarray:
    """Rows (2, P) by which values at the support points give the state at both ends: those of the
    interpolant if `extrapolated`, else those of the first and last node."""
    if extrapolated:
        return evaluation(rule.support, np.array([-1.0, 1.0]))
    return np.eye(len(rule.support))[[0, -1]]


class QuadraticProgram(NamedTuple):
    """Problem B^N in z = (X, U): minimise z^T H z / 2 + cost^T z subject to G z = right."""

    H: np.ndarray
    cost: np.ndarray
    G: np.ndarray
    right: np.ndarray


def quadratic_program(rule: Collocation, problem: Tracking, ends: np.ndarray) -> QuadraticProgram:
    """Problem B^N of `problem`: rows of defects A X - B F = 0, then of end conditions `ends` X =
    x(-1), x(1) where these are fixed.

    **Arguments:** `ends`: of `end_rows`.
    """
    n, P, C = len(problem.b), len(rule.support), len(rule.nodes)
    eye, own = np.eye(n), slice(rule.first, rule.first + C)
    fx = np.einsum("rp,ij->ripj", rule.A, eye)  # of the defects by X
    fx[:, :, own] -= np.einsum("rc,cij->ricj", rule.B, problem.a(rule.nodes))
    fu = -np.einsum("rc,i->ric", rule.B, problem.b)
    held = [i for i in (0, 1) if problem.fixed[i]]
    G = np.block(
        [
            [fx.reshape(-1, P * n), fu.reshape(-1, C)],
            [np.kron(ends[held], eye), np.zeros((len(held) * n, C))],
        ]
    )
    w, target = np.zeros(P), np.zeros((P, n))
    w[own], target[own] = rule.w, problem.target(rule.nodes)
    by_state = np.outer(ends[1], problem.end_cost) - w[:, None] * target
    H = np.diag(np.concatenate([np.repeat(w, n), rule.w]))
    right = [np.zeros(len(rule.A) * n), *(problem.end(i) for i in held)]
    return QuadraticProgram(H, np.append(by_state, np.zeros(C)), G, np.concatenate(right))


def discretise(rule: Collocation, problem: Tracking, ends: np.ndarray) -> Discrete:
    """Discretise, then dualise: the KKT system of problem B^N, one linear solve."""
    n, P = len(problem.b), len(rule.support)
    z, y = kkt(*quadratic_program(rule, problem, ends))
    defect, end = np.split(y, [len(rule.A) * n])
    both = np.zeros((2, n))
    both[[i for i in (0, 1) if problem.fixed[i]]] = end.reshape(-1, n)
    return Discrete(z[: P * n].reshape(P, n), z[P * n :], defect.reshape(-1, n), both)


def discrete_objective(
    rule: Collocation, problem: Tracking, found: Discrete, ends: np.ndarray
) -> float:
    """The cost of problem B^N at the point `found`."""
    off = found.x[rule.first : rule.first + len(rule.nodes)] - problem.target(rule.nodes)
    running = (np.sum(off**2, axis=1) + found.u**2) / 2
    return float(rule.w @ running + problem.end_cost @ (ends[1] @ found.x))


def kkt(
    H: np.ndarray, cost: np.ndarray, G: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Stationary point of z^T H z / 2 + cost^T z subject to G z = right, and its multipliers."""
    m = len(right)
    K = np.block([[H, G.T], [G, np.zeros((m, m))]])
    z = np.linalg.solve(K, np.concatenate([-cost, right]))
    return z[: len(cost)], z[len(cost) :]
