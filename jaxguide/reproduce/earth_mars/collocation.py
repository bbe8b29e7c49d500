"""The collocation matrix V of the 2002 paper, eq. (40), in NumPy: any number of points, either sign
of H_uu.

In JAX every number of points would be another program to compile; NumPy runs them on a second core
while XLA compiles.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.legendre import legval, legvander

from jaxguide.host.compilation import kept_hastily
from jaxguide.neighboring.breaks import place_breaks
from jaxguide.neighboring.linearization import LinearTPBVP, linearize
from jaxguide.neighboring.sweep import collocate
from jaxguide.reproduce.earth_mars.published import GAINS_EXACT
from jaxguide.spectral import nodes_lg, nodes_lgl
from jaxguide.trajectory import Extremal, Point

SIZES = (8, 16, 24, 32, 48, 64, 96, 128)  # the paper's N, N + 1 points; as in the reference's table
SEGMENTS = (8, 16, 24, 48)  # divisors of 48, so that coarser meshes keep every k-th break
SEGMENT_NODES = 8  # by experiment: 48 segments of 8 points give K(0) to 1e-8
CHUNK = 1024  # times evaluated together: one shape, one compilation
WRONG_SIGN_NODES = 64  # points of a horizon, near the paper's 65 (N = 64)


def relative(K: Any, wanted: Any) -> float:
    """Max-norm of `K` - `wanted` over that of `wanted`."""
    wanted = np.asarray(wanted)
    return float(np.max(np.abs(np.asarray(K) - wanted)) / np.max(np.abs(wanted)))


class HamiltonianSystem(NamedTuple):
    """The linear boundary-value problem y' = M y for y = (dx, dlambda), du = U y, psi y(tf) = 0.

    `M` (T, 2n, 2n) and `U` (T, m, 2n) at T times, `psi` (n, 2n).

    **Source:** 2002 paper, eqs. (15)-(18).
    """

    M: np.ndarray
    U: np.ndarray
    psi: np.ndarray


def linearized_at(
    extremal: Extremal, t: np.ndarray, sign: float = 1.0
) -> tuple[Point, HamiltonianSystem]:
    """The extremal and its linear boundary-value problem at times `t` (T,), with `sign` H_uu in
    place of H_uu.

    **Source:** 2002 paper, eqs. (16)-(21).
    """
    parts = []
    for k in range(0, len(t), CHUNK):
        padded = np.pad(t[k : k + CHUNK], (0, max(0, k + CHUNK - len(t))), mode="edge")
        parts.append(jax.device_get(_at(extremal, padded)))
    n = extremal.problem.n
    points = jax.tree_util.tree_map(
        lambda *a: np.concatenate(a)[: len(t)], *(point for point, _ in parts)
    )
    join = lambda name: np.concatenate([getattr(v, name) for _, v in parts])[: len(t)]
    f_x, f_u, H_xx, H_xu, H_uu = (join(name) for name in ("f_x", "f_u", "H_xx", "H_xu", "H_uu"))
    swap = lambda a: a.transpose(0, 2, 1)
    # Equations of the 2002 paper.
    U = -np.linalg.solve(sign * H_uu, np.concatenate([swap(H_xu), swap(f_u)], axis=2))  # eq. (16)
    A, B = f_x + f_u @ U[:, :, :n], f_u @ U[:, :, n:]  # eqs (19), (20)
    Q = H_xx + H_xu @ U[:, :, :n]  # eq. (21)
    M = np.block([[A, B], [-Q, -swap(A)]])
    first = parts[0][1]
    psi = np.concatenate([first.psi_x, first.psi_lambda], axis=1)
    return points, HamiltonianSystem(M, U, psi)


@kept_hastily
def _at(extremal: Extremal, t: Any) -> tuple[Point, LinearTPBVP]:
    return extremal(t), linearize(extremal, t)


def collocated_horizon(
    t: np.ndarray, system: HamiltonianSystem, square: bool = False
) -> np.ndarray:
    """(dx, dlambda) at the LGL points `t` per unit of dx(t[0]), shape (points, 2n, n).

    W by least squares, as in the paper; with `square` the state equation at the first point and the
    costate equation at the last are left out, so that there are as many equations as unknowns.

    **Source:** 2002 paper, eqs. (33), (34), (43), (45).
    """
    points, two_n, _ = system.M.shape
    n, k = two_n // 2, np.arange(points)
    D = np.kron(lgl_differentiation(points - 1), np.eye(two_n))
    V = D.reshape(points, two_n, points, two_n)
    V[k, :, k, :] -= (t[-1] - t[0]) / 2 * system.M  # eqs (33), (34)
    V = V.reshape(points * two_n, points * two_n)
    if square:  # no state equation at the first point, no costate equation at the last
        V = V[n:-n]
    end = np.concatenate([np.zeros((n, two_n * (points - 1))), system.psi], axis=1)
    V = np.concatenate([V, end])
    V0, Ve = V[:, :n], V[:, n:]  # eq. (43)
    if square:
        W = -np.linalg.solve(Ve, V0)
    else:  # R of [Ve V0] holds all that least squares needs; Q is never formed
        R: Any = np.linalg.qr(np.concatenate([Ve, V0], axis=1), mode="r")
        W = -np.linalg.solve(R[:-n, :-n], R[:-n, -n:])
    return np.concatenate([np.eye(n), W]).reshape(points, two_n, n)


def lgl_differentiation(N: int) -> np.ndarray:
    """The differentiation matrix on N + 1 LGL points, in closed form, its diagonal by row sums.

    **Source:** 2002 paper, eq. (32).
    """
    x, _ = nodes_lgl(N + 1)
    L = legval(x, np.eye(N + 1)[N])
    D = L[:, None] / L[None, :] / (x[:, None] - x[None, :] + np.eye(N + 1))
    np.fill_diagonal(D, 0.0)
    np.fill_diagonal(D, -D.sum(axis=1))
    return D


def relative_gain_errors(extremal: Extremal) -> dict[str, dict[float, dict[int, float]]]:
    """Relative error of K(tau) by method, then tau, then number of points.

    Methods: "least squares" and "square" (see `collocated_horizon`), "segmented".
    """
    found: dict[str, dict[float, dict[int, float]]] = {}
    for tau in (0.0, 2.0):
        half = (float(extremal.final_time) - tau) / 2
        grids = [tau + half * (nodes_lgl(N + 1)[0] + 1) for N in SIZES]
        _, systems = linearized_at(extremal, np.concatenate(grids))
        first = 0
        for grid in grids:
            own = slice(first, first + len(grid))
            first = own.stop
            here = HamiltonianSystem(systems.M[own], systems.U[own], systems.psi)
            for name, square in (("least squares", False), ("square", True)):
                W = collocated_horizon(grid, here, square)
                K = (here.U[0] @ W[0])[0]  # 2002 paper, eq. (49), at the first point
                error = relative(K, GAINS_EXACT[tau])
                found.setdefault(name, {}).setdefault(tau, {})[len(grid)] = error
        for points, K in segmented_gains(extremal, tau).items():
            error = relative(K, GAINS_EXACT[tau])
            found.setdefault("segmented", {}).setdefault(tau, {})[points] = error
    return found


def segmented_gains(extremal: Extremal, tau: float) -> dict[int, np.ndarray]:
    """K(tau) by number of points, with the library's own breaks and collocation on SEGMENTS.

    Coarser meshes keep every k-th break and are filled up with empty segments, so that all of them
    are one compiled program.
    """
    span = np.linspace(tau, float(extremal.final_time), 401)
    _, (M, U, psi) = linearized_at(extremal, span)
    finest = np.asarray(_breaks(span, M, SEGMENTS[-1]))
    stride = [SEGMENTS[-1] // s for s in SEGMENTS]
    fill = lambda b: np.pad(b, (0, len(finest) - len(b)), mode="edge")
    breaks = np.stack([fill(finest[::k]) for k in stride])
    widths = np.diff(breaks)
    nodes = nodes_lg(SEGMENT_NODES)[0]
    t = breaks[:, None, :-1] + widths[:, None, :] * (nodes[None, :, None] + 1) / 2
    _, (M, _, _) = linearized_at(extremal, t.reshape(-1))
    M = M.reshape(*t.shape, *M.shape[1:]).transpose(0, 1, 3, 4, 2)
    across = np.asarray(_across(M, widths))
    n, found = len(psi), {}
    for s, transitions in zip(SEGMENTS, across, strict=True):
        G = psi
        for k in reversed(range(s)):
            G = G @ transitions[:, :, k]
        S = -np.linalg.solve(G[:, n:], G[:, :n])
        found[s * SEGMENT_NODES] = (U[0, :, :n] + U[0, :, n:] @ S)[0]
    return found


_breaks = kept_hastily(place_breaks)


@kept_hastily
def _across(M: Array, widths: Array) -> Float[Array, "size row column segment"]:
    # 12 sweeps: more than the 10 with which bench/gains.py reaches 1e-12.
    return jax.vmap(lambda M, w: collocate(M, w, None, 12)[1])(M, widths)


def wrong_sign_systems(
    extremal: Extremal, instants: np.ndarray
) -> tuple[np.ndarray, HamiltonianSystem]:
    """The collocation points of every sample's horizon, and the linear boundary-value problem there
    with -H_uu in place of H_uu in the 2002 paper's eqs. (16)-(21), H_xx unchanged."""
    times = instants[:, :1]
    nodes = nodes_lgl(WRONG_SIGN_NODES)[0]
    grids = times + (float(extremal.final_time) - times) / 2 * (nodes[None, :] + 1)
    _, (M, U, psi) = linearized_at(extremal, grids.reshape(-1), sign=-1.0)
    M, U = (a.reshape(*grids.shape, *a.shape[1:]) for a in (M, U))
    return grids, HamiltonianSystem(M, U, psi)


def wrong_sign_histories(
    grids: np.ndarray, systems: HamiltonianSystem, instants: np.ndarray
) -> np.ndarray:
    """Control per deviation at each sample, 2002 paper, eq. (49), at the `instants` within it."""
    degree = grids.shape[1] - 1
    to_coefficients = np.linalg.inv(legvander(nodes_lgl(degree + 1)[0], degree))
    M, U, psi = systems
    found = []
    for k, grid in enumerate(grids):
        du = U[k] @ collocated_horizon(grid, HamiltonianSystem(M[k], U[k], psi))
        basis = legvander(2 * (instants[k] - grid[0]) / (grid[-1] - grid[0]) - 1, degree)
        found.append(np.tensordot(basis @ to_coefficients, du, 1))
    return np.stack(found)
