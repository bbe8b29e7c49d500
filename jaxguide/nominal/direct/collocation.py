"""Collocation on segments: which nodes carry state, control and defects. Host-side constants."""

import functools as ft
from typing import NamedTuple

import numpy as np

from jaxguide.spectral import grid
from jaxguide.spectral.grids import differentiation

FAMILIES = ("lgl", "cgl", "lgr-left", "lgr-right", "lg")


class Collocation(NamedTuple):
    """One segment on tau in [-1, 1]. The state lives at P `support` points, the first of them -1
    and the last +1; control and dynamics live at C `nodes`, which are the support points
    first ... first + C - 1. `w` are the quadrature weights of the nodes.

    Defect i of R is `A`[i] X - `B`[i] F, with F = (dt/dtau) f at the nodes: the constraints of
    problem B^N, review, eq. (21). Rows `main` determine the states after the first point; rows
    `extra` (of LGL and CGL, whose polynomial meets the dynamics at both ends: the one at -1)
    restrict the control.
    """

    support: np.ndarray
    nodes: np.ndarray
    first: int
    w: np.ndarray
    A: np.ndarray
    B: np.ndarray
    main: np.ndarray
    extra: np.ndarray


@ft.cache
def collocation(family: str, points: int) -> Collocation:
    """`points` collocation nodes of a family.

    **Arguments:** `family`: "lgl", "cgl" (Chebyshev-Gauss-Lobatto), "lgr-left", "lgr-right" (Radau
    with -1 or +1 among the nodes; the state also lives at the other end) or "lg" (the state also
    lives at both ends; the last by quadrature).

    **Raises:** `ValueError` for another family or too few points.

    **Source:** Ross & Karpenko, review (2012), eqs (10)-(16), (21).
    """
    if family not in FAMILIES:
        raise ValueError(f"grid is {family!r}; choose one of {', '.join(FAMILIES)}.")
    least = 3 if family in ("lgl", "cgl") else 2
    if points < least:
        raise ValueError(f"nodes is {points}; {family!r} needs at least {least}.")
    own = grid(family, points)
    rows = np.arange(points)
    if family in ("lgl", "cgl"):
        return Collocation(
            own.x, own.x, 0, own.w, own.differentiation, np.eye(points), rows[1:], rows[:1]
        )
    none = rows[:0]
    if family == "lgr-left":
        support = np.append(own.x, 1.0)
        A = differentiation(support)[:-1]
        return Collocation(support, own.x, 0, own.w, A, np.eye(points), rows, none)
    support = np.append(-1.0, own.x)
    A = differentiation(support)[1:]
    if family == "lgr-right":
        return Collocation(support, own.x, 1, own.w, A, np.eye(points), rows, none)
    # LG: the last state is the first plus the quadrature of the dynamics, review, eq. (15).
    end = np.zeros(points + 2)
    end[0], end[-1] = -1.0, 1.0
    A = np.concatenate([np.pad(A, ((0, 0), (0, 1))), end[None]])
    B = np.concatenate([np.eye(points), own.w[None]])
    return Collocation(np.append(support, 1.0), own.x, 1, own.w, A, B, np.arange(points + 1), none)


@ft.cache
def left_null(family: str, points: int) -> np.ndarray:
    """The vector v with v^T D = 0, of a grid whose nodes hold both ends (w P_N on LGL). Defect
    multipliers may carry a multiple of it, which the costate equations hardly see."""
    _, _, right = np.linalg.svd(grid(family, points).differentiation.T)
    return right[-1]
