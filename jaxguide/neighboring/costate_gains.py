"""Gains at one time, from the adjoint rows there: of costate, control and final time."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.linalg import gauss_solve
from jaxguide.neighboring.linearization import Canonical
from jaxguide.neighboring.sweep import Sweep

_TINY = 1e-300  # keeps 0/0 out where nothing changes at all


class CostateGains(NamedTuple):
    """Changes per deviation of state, parameters and target (the `known`), in user units."""

    S: Float[Array, "n known"]  # of the costate
    K: Float[Array, "m known"]  # of the control
    time: Float[Array, " known"]  # of the final time, where it is free
    rounding: Float[Array, ""]  # bound on the rounding error of S, relative to its size


@functools.partial(jax.jit, static_argnames="free_time")
def gains_at(sweep: Sweep, c: Canonical, t: Array, free_time: bool) -> CostateGains:
    """S = -G_lambda^-1 [G_x G_p G_target] and K = U_x + U_lambda S at `t`, with U of the 2002
    paper's eq. (16) in `c`."""
    two_n = sweep.scale.shape[0]
    n = two_n // 2
    G = sweep.rows(t)
    known = jnp.concatenate([G[:n, :n], G[:n, two_n:]], axis=1)
    S, rounding = _solved(G[:n, n:two_n], known)
    width = jnp.concatenate([sweep.scale[:n], jnp.ones(known.shape[1] - n, G.dtype)])
    S = sweep.scale[n:, None] * S / width[None, :]
    targets = known.shape[1] - n - c.U_p.shape[1]
    direct = [c.U[:, :n], c.U_p, jnp.zeros((c.U.shape[0], targets), G.dtype)]
    K = jnp.concatenate(direct, axis=1) + c.U[:, n:] @ S
    if not free_time:
        return CostateGains(S, K, jnp.zeros(known.shape[1], G.dtype), rounding)
    row = G[n]  # dtf = row (dx, dlambda, dp, dtarget)
    by_costate = row[n:two_n] / sweep.scale[n:]
    by_known = jnp.concatenate([row[:n], row[two_n:]]) / width
    return CostateGains(S, K, by_known + by_costate @ S, rounding)


def _solved(
    G: Float[Array, "n n"], known: Float[Array, "n known"]
) -> tuple[Float[Array, "n known"], Float[Array, ""]]:
    """S with G S = -known, refined once, and Skeel's bound on its relative rounding error."""
    inverse = gauss_solve(G, jnp.eye(G.shape[0], dtype=G.dtype))
    S = -inverse @ known
    S = S - inverse @ (G @ S + known)
    size = jnp.abs(inverse) @ (jnp.abs(G) @ jnp.abs(S) + jnp.abs(known))
    return S, jnp.finfo(G.dtype).eps * jnp.max(size) / jnp.max(jnp.abs(S) + _TINY)
