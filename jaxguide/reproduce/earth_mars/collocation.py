"""V of eq. (40) in NumPy, for any number of points and either sign of H_uu.

Every size would be a program of its own to compile; NumPy runs them beside what XLA does.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.legendre import legval, legvander

from jaxguide.neighboring.breaks import place_breaks
from jaxguide.neighboring.linearization import LinearTPBVP, linearize
from jaxguide.neighboring.sweep import collocate
from jaxguide.reproduce.earth_mars.published import GAINS_EXACT
from jaxguide.spectral import nodes_lg, nodes_lgl
from jaxguide.trajectory import Extremal, Point

SIZES = (8, 16, 24, 32, 48, 64, 96, 128)  # N of the paper: N + 1 points
SEGMENTS = (8, 16, 24, 48)
SEGMENT_NODES = 8
CHUNK = 1024  # times evaluated together: one shape, one compilation
WRONG_SIGN_NODES = 64


def relative(K: Any, wanted: Any) -> float:
    """Max-norm error of a row over its size."""
    wanted = np.asarray(wanted)
    return float(np.max(np.abs(np.asarray(K) - wanted)) / np.max(np.abs(wanted)))


class System(NamedTuple):
    """y' = M y for y = (dx, dlambda), du = U y, and psi y(tf) = 0: eqs (15)-(18)."""

    M: np.ndarray
    U: np.ndarray
    psi: np.ndarray


def at(extremal: Extremal, t: np.ndarray, sign: float = 1.0) -> tuple[Point, System]:
    """The extremal and its linear TPBVP at times `t` (T,), with `sign` H_uu in place of H_uu."""
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
    U = -np.linalg.solve(sign * H_uu, np.concatenate([swap(H_xu), swap(f_u)], axis=2))  # eq. (16)
    A, B = f_x + f_u @ U[:, :, :n], f_u @ U[:, :, n:]  # eqs (19), (20)
    Q = H_xx + H_xu @ U[:, :, :n]  # eq. (21)
    M = np.block([[A, B], [-Q, -swap(A)]])
    return points, System(M, U, np.concatenate([parts[0][1].psi_x, parts[0][1].psi_lambda], axis=1))


@eqx.filter_jit
def _at(extremal: Extremal, t: Any) -> tuple[Point, LinearTPBVP]:
    return extremal(t), linearize(extremal, t)


def horizon(t: np.ndarray, system: System, square: bool = False) -> np.ndarray:
    """(dx, dlambda) at LGL points `t` per dx(t[0]): W of eq. (45), or of as many equations as
    unknowns. (points, 2n, n)."""
    points, two_n, _ = system.M.shape
    n, k = two_n // 2, np.arange(points)
    V = np.kron(differentiation(points - 1), np.eye(two_n)).reshape(points, two_n, points, two_n)
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


def differentiation(N: int) -> np.ndarray:
    """The differentiation matrix on N + 1 LGL points."""
    x, _ = nodes_lgl(N + 1)
    L = legval(x, np.eye(N + 1)[N])
    D = L[:, None] / L[None, :] / (x[:, None] - x[None, :] + np.eye(N + 1))
    np.fill_diagonal(D, 0.0)
    np.fill_diagonal(D, -D.sum(axis=1))
    return D


def gain_errors(extremal: Extremal) -> dict[str, dict[float, dict[int, float]]]:
    """Method -> tau -> points -> relative error of K(tau)."""
    found: dict[str, dict[float, dict[int, float]]] = {}
    for tau in (0.0, 2.0):
        half = (float(extremal.final_time) - tau) / 2
        grids = [tau + half * (nodes_lgl(N + 1)[0] + 1) for N in SIZES]
        _, systems = at(extremal, np.concatenate(grids))
        first = 0
        for grid in grids:
            own = slice(first, first + len(grid))
            first = own.stop
            here = System(systems.M[own], systems.U[own], systems.psi)
            for name, square in (("least squares", False), ("square", True)):
                K = (here.U[0] @ horizon(grid, here, square)[0])[0]  # eq. (49) at the first point
                error = relative(K, GAINS_EXACT[tau])
                found.setdefault(name, {}).setdefault(tau, {})[len(grid)] = error
        for points, K in segmented_gains(extremal, tau).items():
            error = relative(K, GAINS_EXACT[tau])
            found.setdefault("segmented", {}).setdefault(tau, {})[points] = error
    return found


def segmented_gains(extremal: Extremal, tau: float) -> dict[int, np.ndarray]:
    """Points -> K(tau) by the library's own breaks and collocation, on ever more SEGMENTS.

    Coarser meshes keep every k-th break, and are filled with empty segments: all are one program.
    """
    span = np.linspace(tau, float(extremal.final_time), 401)
    _, (M, U, psi) = at(extremal, span)
    finest = np.asarray(_breaks(span, M, SEGMENTS[-1]))
    stride = [SEGMENTS[-1] // s for s in SEGMENTS]
    fill = lambda b: np.pad(b, (0, len(finest) - len(b)), mode="edge")
    breaks = np.stack([fill(finest[::k]) for k in stride])
    widths = np.diff(breaks)
    nodes = nodes_lg(SEGMENT_NODES)[0]
    t = breaks[:, None, :-1] + widths[:, None, :] * (nodes[None, :, None] + 1) / 2
    _, (M, _, _) = at(extremal, t.reshape(-1))
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


_breaks = jax.jit(place_breaks, static_argnums=2)


@jax.jit
def _across(M: Array, widths: Array) -> Float[Array, "size row column segment"]:
    return jax.vmap(lambda M, w: collocate(M, w, None, 12)[1])(M, widths)


def wrong_sign_systems(extremal: Extremal, instants: np.ndarray) -> tuple[np.ndarray, System]:
    """The points of every sample's horizon, and the linear TPBVP there with -H_uu in place of
    H_uu in eqs (16)-(21) and H_xx as it is."""
    times = instants[:, :1]
    nodes = nodes_lgl(WRONG_SIGN_NODES)[0]
    grids = times + (float(extremal.final_time) - times) / 2 * (nodes[None, :] + 1)
    _, (M, U, psi) = at(extremal, grids.reshape(-1), sign=-1.0)
    M, U = (a.reshape(*grids.shape, *a.shape[1:]) for a in (M, U))
    return grids, System(M, U, psi)


def wrong_sign_histories(grids: np.ndarray, systems: System, instants: np.ndarray) -> np.ndarray:
    """Control histories of eq. (49) at the `instants` of every sample, the first included."""
    degree = grids.shape[1] - 1
    to_coefficients = np.linalg.inv(legvander(nodes_lgl(degree + 1)[0], degree))
    M, U, psi = systems
    found = []
    for k, grid in enumerate(grids):
        du = U[k] @ horizon(grid, System(M[k], U[k], psi))
        basis = legvander(2 * (instants[k] - grid[0]) / (grid[-1] - grid[0]) - 1, degree)
        found.append(np.tensordot(basis @ to_coefficients, du, 1))
    return np.stack(found)
