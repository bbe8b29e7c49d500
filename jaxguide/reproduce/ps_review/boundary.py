"""The review's Table 1 in numbers: errors of each grid on one problem with three kinds of ends."""

import numpy as np

from jaxguide.reproduce.ps_review.lq import Tracking, discretise, end_rows, review_grid

ENDS = {"fixed-fixed": (True, True), "fixed-free": (True, False), "free-free": (False, False)}
GRIDS = ("lgl", "lgr-left", "lg")


def problem(fixed: tuple[bool, bool]) -> Tracking:
    r"""$\dot x = u$ with the target r for which $x = e^{\sin(\pi t/2)}$ is optimal, whichever ends
    are fixed.

    The slope of x, which is -lambda, vanishes at both ends, and so do the multipliers of fixed
    ends. From the costate equation $r = x + \dot\lambda = x - \ddot x$.
    """
    k = np.pi / 2
    x = lambda t: np.exp(np.sin(k * t))
    slope = lambda t: k * np.cos(k * t) * x(t)
    target = lambda t: (1 - k**2 * (np.cos(k * t) ** 2 - np.sin(k * t))) * x(t)
    return Tracking(
        a=lambda t: np.zeros((len(t), 1, 1)), b=np.ones(1), target=lambda t: target(t)[:, None],
        state=lambda t: x(t)[:, None], control=slope, costate=lambda t: -slope(t)[:, None],
        end_cost=np.zeros(1), fixed=fixed,
    )  # fmt: skip


def error(family: str, kind: str, points: int, extrapolated: bool = False) -> float:
    """max |x_i - x(t_i)| of `problem` with ends of a `kind` (a key of ENDS).

    End conditions hold at the first and last node, x_0 and x_N, or with `extrapolated` at the ends
    of the interpolant.
    """
    p, rule = problem(ENDS[kind]), review_grid(family, points)
    found = discretise(rule, p, end_rows(rule, extrapolated))
    return float(np.max(np.abs(found.x - p.state(rule.nodes))))
