"""Table 1 in numbers: one problem with three kinds of ends, on each grid, and what a grid errs."""

import numpy as np

from jaxguide.reproduce.ps_review.lq import Tracking, discretise, end_rows, review_grid

ENDS = {"fixed-fixed": (True, True), "fixed-free": (True, False), "free-free": (False, False)}
GRIDS = ("lgl", "lgr-left", "lg")


def problem(fixed: tuple[bool, bool]) -> Tracking:
    r"""$\dot x = u$ tracking what makes $x = e^{\sin(\pi t/2)}$ optimal, whichever ends are fixed.

    Its slope, -lambda, vanishes at both ends, and so do the multipliers of fixed ones. Then
    $r = x + \dot\lambda = x - \ddot x$.
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
    """max |x_i - x(t_i)|, with x_0 and x_N (or the interpolant's ends) in e(x_0, x_N)."""
    p, rule = problem(ENDS[kind]), review_grid(family, points)
    found = discretise(rule, p, end_rows(rule, extrapolated))
    return float(np.max(np.abs(found.x - p.state(rule.nodes))))
