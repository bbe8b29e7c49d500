"""The Legendre pseudospectral gain map on each remaining horizon: 2002 paper, eqs (22)-(49)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.neighboring.linearization import canonical, second_variation, terminal_conditions
from jaxguide.spectral import differentiation_matrix, nodes_lgl
from jaxguide.trajectory import Extremal


def assemble(
    D: Float[Array, "point point"],
    half: Float[Array, ""],
    M: Float[Array, "point two_n two_n"],
    psi: Float[Array, "n two_n"],
) -> Float[Array, "row column"]:
    """V of the 2002 paper's eq. (40): the canonical equations (36), (37) at all LGL points, then
    the end conditions (41), (42).

    Unknowns Z = (X, Lambda), each stacked node by node: 2002 paper, eq. (35). `half`: half of the
    horizon's length.
    """
    points, n = D.shape[0], psi.shape[0]
    eye = jnp.eye(n, dtype=D.dtype)
    same = jnp.eye(points, dtype=D.dtype)
    block = lambda a: jnp.einsum("kl,kij->kilj", same, a).reshape(points * n, points * n)
    derivative = jnp.einsum("kl,ij->kilj", D, eye).reshape(points * n, points * n)
    upper = [derivative - half * block(M[:, :n, :n]), -half * block(M[:, :n, n:])]
    lower = [-half * block(M[:, n:, :n]), derivative - half * block(M[:, n:, n:])]
    gap = jnp.zeros((n, (points - 1) * n), D.dtype)
    end = [gap, psi[:, :n], gap, psi[:, n:]]  # 2002 paper, eqs (41), (42)
    return jnp.concatenate([jnp.concatenate(row, axis=1) for row in (upper, lower, end)])


def _square_rows(points: int, n: int) -> np.ndarray:
    """Rows kept by the square variant: no state equation at the first point, no costate
    equation at the last. 2n fewer rows leave as many equations as unknowns."""
    rows = np.arange(n * (2 * points + 1))
    state_first = rows < n
    costate_last = (rows >= n * (2 * points - 1)) & (rows < 2 * n * points)
    return rows[~(state_first | costate_last)]


class Horizons(NamedTuple):
    """Deviations at the LGL points of the horizon from each time to the end, per deviation of the
    state at its start."""

    nodes: Float[Array, " node"]  # of [-1, 1]
    states: Float[Array, "time node n n"]  # W1 of the 2002 paper's eq. (46), with I for x_0 on top
    controls: Float[Array, "time node m n"]  # 2002 paper, eq. (49)


def solve_horizons(
    extremal: Extremal, times: Float[Array, " time"], nodes: int, square: bool
) -> Horizons:
    """W of the 2002 paper's eq. (45), and with it the histories of state and control, for the
    horizon of each time.

    Least squares by QR, one horizon at a time: LAPACK under `vmap` may hang, and one horizon's
    matrices are large enough to use all cores. W follows from R of [Ve V0] alone, so that Q is
    never formed. No singular value is cut off (no `rcond`). `square`: 2n of the equations are left
    out, and as many as unknowns are solved.
    """
    problem, n = extremal.problem, extremal.problem.n
    tau = jnp.asarray(nodes_lgl(nodes)[0], times.dtype)
    D = differentiation_matrix(tau)
    psi = terminal_conditions(extremal).psi
    keep = _square_rows(nodes, n) if square else None

    def one(t0: Array) -> tuple[Array, Array]:
        half = (extremal.t[-1] - t0) / 2
        t = t0 + half * (tau + 1)  # 2002 paper, eq. (22)
        point = extremal(t)
        v = jax.vmap(lambda t, x, u, c: second_variation(problem, t, x, u, c))(t, *point)
        c = jax.vmap(canonical)(v)
        V = assemble(D, half, c.M, psi)
        V = V if keep is None else V[keep]
        V0, Ve = V[:, :n], V[:, n:]  # 2002 paper, eq. (43)
        if keep is None:
            R = jnp.linalg.qr(jnp.concatenate([Ve, V0], axis=1), mode="r")
            W = -jax.scipy.linalg.solve_triangular(R[:-n, :-n], R[:-n, -n:])  # 2002 paper, eq. (45)
        else:
            W = -jnp.linalg.solve(Ve, V0)
        W = jnp.concatenate([jnp.eye(n, dtype=W.dtype), W])
        W1, W2 = W.reshape(2, nodes, n, n)  # 2002 paper, eqs (46), (47)
        return W1, c.U[..., :n] @ W1 + c.U[..., n:] @ W2

    return Horizons(tau, *jax.lax.map(one, times))
