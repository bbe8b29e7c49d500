"""Conjugate points: an extremal with one ahead is no minimum from here on."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.linalg import cholesky_positive, gauss_solve
from jaxguide.neighboring.sweep import Sweep


def conjugate_ahead(sweep: Sweep, times: Float[Array, " time"]) -> Array:
    """Whether a conjugate point lies between each time and the end.

    Across a segment dx(l) = Phi_11 (I + N S) dx(r) with N = Phi_11^-1 Phi_12 >= 0 symmetric, of
    the transition from its end r back to l. Every conjugate point inside turns one eigenvalue of
    I + N S, all real, negative. Cholesky of I + L^T S L, N = L L^T, fails for any such eigenvalue;
    the sign of a determinant would miss two conjugate points at one time.
    """
    n = sweep.scale.shape[0] // 2
    eye = jnp.eye(n, dtype=sweep.scale.dtype)

    def crossed(i: Array, l: Array) -> Array:
        forward = sweep.transition(i, l)[:, : 2 * n]  # its inverse is [[d^T, -b^T], ...]
        b, d = forward[:n, n:], forward[n:, n:]
        G = sweep.ends[i][:n, : 2 * n]
        # Both systems at once: elimination is unrolled, and compiled for each call.
        S, N = jax.vmap(gauss_solve)(jnp.stack([G[:, n:], d.T]), jnp.stack([-G[:, :n], -b.T]))
        L = _root(N)
        return ~cholesky_positive(eye + L.T @ ((S + S.T) / 2) @ L)

    # Nothing is conjugate within the last segment of a resolved mesh, where S may be infinite.
    last = sweep.breaks.shape[0] - 2
    at = jax.vmap(sweep.locate)(times)
    segments = jnp.arange(last, dtype=at.dtype)
    found = jax.vmap(crossed)(
        jnp.concatenate([segments, at]), jnp.concatenate([sweep.breaks[:-2], times])
    )
    whole, own = found[:last], found[last:] & (at < last)
    return own | jnp.any(whole[None, :] & (segments[None, :] > at[:, None]), axis=1)


def _root(N: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L with L L^T = N for a symmetric semidefinite N: Cholesky that skips empty pivots."""
    columns = []
    tiny = jnp.finfo(N.dtype).eps * jnp.max(jnp.abs(N))
    for k in range(N.shape[0]):
        pivot = N[k, k]
        column = jnp.where(pivot > tiny, N[:, k] / jnp.sqrt(jnp.maximum(pivot, tiny)), 0.0)
        columns.append(column)
        N = N - jnp.outer(column, column)
    return jnp.stack(columns, axis=1)
