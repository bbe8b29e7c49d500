"""Collocation on segments: which nodes carry state, control and defects. Host-side constants."""

import functools as ft
from typing import NamedTuple

import numpy as np

from jaxguide.spectral import NodeFamily, grid
from jaxguide.spectral.grids import differentiation


class Collocation(NamedTuple):
    """One segment on tau in [-1, 1]. The state lives at P `support` points, the first of them -1
    and the last +1; control and dynamics live at C `nodes`, which are the support points
    first ... first + C - 1. `w` are the quadrature weights of the nodes.

    Defect i of R is `A`[i] X - `B`[i] F, with the states X (P, n) at the support points and
    F = (dt/dtau) f (C, n) at the nodes: Ross & Karpenko, review (2012), problem B^N, eq. (21).
    `w` (C,) are quadrature weights, of sum 2. Rows `main` determine the states after the first. The
    rows `extra` restrict the control: where both ends are nodes, the one at -1; otherwise none.
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
def collocation(family: str | NodeFamily, points: int) -> Collocation:
    """`points` collocation nodes of a family; which kind of collocation, its ends decide.

    Where both ends are nodes (LGL, CGL) the state lives at the nodes, and there is one defect more
    than states after the first. Where one is (LGR), the state also lives at the other. Where none
    is (LG), it also lives at both ends, at the last by quadrature.

    **Arguments:** `family`: "lgl", "cgl", "lgr-left", "lgr-right", "lg" or a `NodeFamily`.

    **Raises:** `ValueError` for another family, too few points (3 with both ends, else 2), or nodes
    that break the contract of `NodeFamily`.

    **Source:** Ross & Karpenko, review (2012), eqs. (10)-(16), (21).
    """
    own = grid(family, points)
    left, right = own.x[0] == -1.0, own.x[-1] == 1.0
    least = 3 if left and right else 2
    if points < least:
        raise ValueError(f"nodes is {points}; {family!r} needs at least {least}.")
    x, w, eye, rows = own.x, own.w, np.eye(points), np.arange(points)
    none = rows[:0]
    if left and right:
        return Collocation(x, x, 0, w, own.differentiation, eye, rows[1:], rows[:1])
    if left:
        support = np.append(x, 1.0)
        return Collocation(support, x, 0, w, differentiation(support)[:-1], eye, rows, none)
    support = np.append(-1.0, x)
    A = differentiation(support)[1:]
    if right:
        return Collocation(support, x, 1, w, A, eye, rows, none)
    # The last state is the first plus the quadrature of the dynamics: review, eq. (15).
    end = np.zeros(points + 2)
    end[0], end[-1] = -1.0, 1.0
    A = np.concatenate([np.pad(A, ((0, 0), (0, 1))), end[None]])
    B = np.concatenate([eye, w[None]])
    return Collocation(np.append(support, 1.0), x, 1, w, A, B, np.arange(points + 1), none)


@ft.cache
def left_null(family: str | NodeFamily, points: int) -> np.ndarray:
    """v with v^T D = 0, of a grid with both ends among its nodes: w P_N on LGL, N = `points` - 1.

    Defect multipliers may carry a multiple of it, which the costate equations hardly determine;
    the two closure conditions do.

    **Source:** Ross & Karpenko, review (2012), section 4.1, Remark 3.
    """
    _, _, right = np.linalg.svd(grid(family, points).differentiation.T)
    return right[-1]
