r"""Rates of convergence on LGL: Theorem 2 (feasibility) and Kang's rate of the cost, both in Ross &
Karpenko, review (2012), section 4.3.

Each state is smooth but for one jump of its derivative of order m, so it is in $W^{m,\infty}$:
$x = \sin 2t + \operatorname{sgn}(t - c) (t - c)^m$. For it to be optimal, the running cost has the
jump too; `Saturated` has smooth data, and a control that leaves its bound.
"""

import numpy as np

from jaxguide.reproduce.ps_review.lq import (
    Tracking,
    discrete_objective,
    discretise,
    end_rows,
    quadratic_program,
    review_grid,
)
from jaxguide.reproduce.ps_review.qp import solve_qp
from jaxguide.spectral import nodes_lg
from jaxguide.spectral.grids import grid

KINK = 0.2718281828  # c: not a node of any grid used
SIZES = (8, 11, 16, 23, 32, 45, 64, 91, 128)  # points: powers of sqrt 2


def path(t: np.ndarray, m: int | None, order: int = 0) -> np.ndarray:
    """The derivative of x of that `order` at `t`, for a jump of order `m`; None: no jump."""
    smooth = 2.0**order * np.sin(2 * t + order * np.pi / 2)
    if m is None:
        return smooth
    d = t - KINK
    factor = np.prod(np.arange(m, m - order, -1))
    return smooth + factor * np.sign(d) * d ** (m - order)


def feasible(points: int, m: int | None) -> tuple[float, float]:
    r"""Review, Theorem 2, for $\dot x = u$: the least residual delta^N, and max |x_i - x(t_i)| with
    that residual.

    With u_i = u(t_i) the equations D X = u are one too many: they have a solution only if v^T u = 0
    for the v with v^T D = 0. The least max-norm of the residual is delta = |v^T u| / |v|_1, with
    the residual delta sign(v).
    """
    own = grid("lgl", points)
    u = path(own.x, m, 1)
    v = own.w * np.polynomial.legendre.legval(own.x, np.eye(points)[-1])
    delta = v @ u / np.sum(np.abs(v))
    # The interpolant of u less the residual has degree N - 1, so D differentiates its integral.
    x = own.integration @ (u - delta * np.sign(v))
    off = x + path(own.x[:1], m) - path(own.x, m)
    return abs(float(delta)), float(np.max(np.abs(off)))


def tracking(m: int | None) -> Tracking:
    r"""$\dot x = u$ tracking $r = x - \ddot x$, for which `path` is optimal."""
    column = lambda order, sign: lambda t: sign * path(t, m, order)[:, None]
    return Tracking(
        a=lambda t: np.zeros((len(t), 1, 1)), b=np.ones(1),
        target=lambda t: (path(t, m) - path(t, m, 2))[:, None],
        state=column(0, 1), control=lambda t: path(t, m, 1), costate=column(1, -1),
        end_cost=-path(np.ones(1), m, 1),
    )  # fmt: skip


def optimal(points: int, m: int | None) -> tuple[float, float, float]:
    """Errors of J, of x and of u (the greatest at the nodes) of the solution of problem B^N."""
    problem, rule = tracking(m), review_grid("lgl", points)
    ends = end_rows(rule, extrapolated=False)
    found = discretise(rule, problem, ends)
    value = discrete_objective(rule, problem, found, ends)
    off = lambda y, z: float(np.max(np.abs(y - z)))
    return (
        abs(value - exact(m)),
        off(found.x, problem.state(rule.nodes)),
        off(found.u, problem.control(rule.nodes)),
    )


class Saturated:
    r"""$\int_{-1}^1 (x^2 + u^2)/2\,dt$, $\dot x = u$, |u| <= 1; the start is such that u leaves -1
    at t = c.

    After that u = -tanh(1 - t) x (Riccati equation). u has a corner, so that x is in
    $W^{2,\infty}$.
    """

    m = 2
    at_corner = 1 / np.tanh(1 - KINK)
    start = at_corner + KINK + 1

    @classmethod
    def state(cls, t: np.ndarray) -> np.ndarray:
        """The optimal x at the times `t`."""
        later = cls.at_corner * np.cosh(1 - t) / np.cosh(1 - KINK)
        return np.where(t < KINK, cls.start - (t + 1), later)

    @classmethod
    def value(cls) -> float:
        """The optimal J."""
        until = (cls.start**3 - cls.at_corner**3) / 3 + (KINK + 1)
        return float(until + cls.at_corner**2 * np.tanh(1 - KINK)) / 2

    @classmethod
    def errors(cls, points: int) -> tuple[float, float]:
        """Errors of J and of x (greatest at the nodes)."""
        zero = lambda t: np.zeros((len(t), 1))
        state = lambda t: cls.state(t)[:, None]
        problem = Tracking(lambda t: np.zeros((len(t), 1, 1)), np.ones(1), zero, state,
                           zero, zero, np.zeros(1))  # fmt: skip
        rule = review_grid("lgl", points)
        system = quadratic_program(rule, problem, end_rows(rule, extrapolated=False))
        upper = np.concatenate([np.full(points, np.inf), np.ones(points)])
        found = solve_qp(*system, -upper, upper)
        if found.violation > 1e-9:  # of order 1 where the active set has not settled
            return np.nan, np.nan
        x = found.z[:points]
        value = found.z @ system.H @ found.z / 2
        return float(abs(value - cls.value())), float(np.max(np.abs(x - cls.state(rule.nodes))))


def exact(m: int | None) -> float:
    """J of `path`, by Gauss quadrature on either side of the jump."""
    points, w = nodes_lg(40)  # exact to rounding for these integrands
    value = -float(path(np.ones(1), m, 1)[0] * path(np.ones(1), m)[0])
    for a, b in ((-1.0, KINK), (KINK, 1.0)):
        t = (a + b) / 2 + (b - a) / 2 * points
        value += (b - a) / 4 * float(w @ (path(t, m, 1) ** 2 + path(t, m, 2) ** 2))
    return value


def slope(sizes: tuple[int, ...], errors: np.ndarray) -> float:
    """Slope of the regression of log error on log(N - 1), with the review's N, points less one."""
    return float(np.polyfit(np.log(np.array(sizes) - 2), np.log(errors), 1)[0])
