r"""One backward sweep: the adjoint rows on short segments, collocated and joined.

The adjoint rows $G(t) = [G_x\ G_\lambda]$ of the end conditions, $\dot G = -G M$,
$G(t_f) = [\psi_x\ \psi_\lambda]$, annihilate every neighbouring extremal: $G y = 0$ at all times
for $y = (\delta x, \delta\lambda)$, so $\delta\lambda = S\,\delta x$ with $S = -G_\lambda^{-1}
G_x$. Unlike a Riccati sweep nothing is infinite at a hard end. On each segment the transition
matrix is collocated at Gauss points in integral form (which superconverges) by Picard sweeps, all
segments at once; then the segments are joined.

Arrays run (node, row, column, segment): the batch is last, so that small products vectorise.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.spectral import interpolation_matrix, interval, nodes_lg

# Segments joined without making the rows orthonormal in between: they grow little over so few.
# Chosen, not tuned.
GROUP = 8


class Sweep(NamedTuple):
    """The adjoint rows on all segments: everything needed to evaluate them at any time.

    Scaled: y = scale * (scaled y). Columns beyond 2n are those of parameters, then (in `ends`) of
    the target; w counts them all.
    """

    nodes: Float[Array, " s"]  # Gauss points of [-1, 1]
    breaks: Float[Array, " edge"]
    slopes: Float[Array, "segment s two_n w"]  # (Psi(t_j) - I) / (t_e - t_j), Psi = Phi(t_e, t)
    ends: Float[Array, "segment row w"]  # G at each segment's end
    scale: Float[Array, " two_n"]

    def locate(self, t: Array) -> Array:
        """The index of the segment that `t` is in."""
        return interval(self.breaks, t)

    def transition(self, i: Array, t: Array) -> Float[Array, "two_n w"]:
        """Phi(t_e, t) from `t` to the end t_e of segment `i`, scaled, with the columns of
        parameters."""
        a, b = self.breaks[i], self.breaks[i + 1]
        tau = (2 * t - a - b) / jnp.where(b > a, b - a, 1.0)
        row = interpolation_matrix(self.nodes, tau[None])[0]
        slope = jnp.tensordot(row, self.slopes[i], 1)
        return identity(slope.shape, slope.dtype) + (b - t) * slope

    def rows(self, t: Array) -> Float[Array, "row w"]:
        """G(t), scaled."""
        i = self.locate(t)
        two_n = self.scale.shape[0]
        end = self.ends[i]
        moved = self.transition(i, t)
        w = moved.shape[1]  # the target's columns beyond are constant
        change = end[:, :two_n] @ (moved - identity((two_n, w), end.dtype))
        return end.at[:, :w].add(change)


def identity(shape: tuple[int, ...], dtype: Any) -> Float[Array, "two_n w"]:
    """The transition over no time: ones on the diagonal, no part of the parameters."""
    return jnp.eye(shape[0], shape[1], dtype=dtype)


def _gauss_integration(s: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss nodes, weights, and W with W_ij = integral of l_j from tau_i to 1."""
    x, w = nodes_lg(s)
    legendre = np.polynomial.legendre
    vander = legendre.legvander(x, s - 1)
    coefficients = vander.T * w[None, :] * (np.arange(s)[:, None] + 0.5)  # exact projection
    primitive = np.stack([legendre.legint(np.eye(s)[k], lbnd=1.0) for k in range(s)])
    W = -(legendre.legval(x, primitive.T).T @ coefficients)
    return x, w, W


def collocate(
    M: Float[Array, "s two_n w segment"],
    widths: Float[Array, " segment"],
    start: Float[Array, "s two_n w segment"] | None,
    sweeps: int,
) -> tuple[Float[Array, "s two_n w segment"], Float[Array, "two_n w segment"]]:
    """Phi(t_e, t) with parameter columns, at the Gauss nodes and at the segment's start, by
    `sweeps` Picard sweeps from `start` (None: the identity)."""
    s, two_n, w, _ = M.shape
    _, weights, W = _gauss_integration(s)
    # The last row leads to the segment's start: a sweep costs little more with it, and the product
    # is compiled once.
    W = jnp.asarray(np.concatenate([W, weights[None]]), M.dtype)
    half = (widths / 2)[None, None, None, :]
    eye = identity((two_n, w), M.dtype)[None, :, :, None]

    def times_m(psi: Array) -> Array:
        products = [psi[:, :, k, None] * M[:, None, k] for k in range(two_n)]
        return sum(products[1:], products[0])

    # The first sweep from Psi = I needs no product: F = M.
    psi = eye + half * jnp.tensordot(W[:s], M, 1) if start is None else start

    def sweep(_: Any, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        psi = carry[0]
        out = eye + half * jnp.tensordot(W, times_m(psi), 1)
        return out[:s], psi, out[s]

    # One sweep more, for the start that belongs to the last Psi.
    carry = (psi, psi, psi[0])
    _, psi, begin = jax.lax.fori_loop(0, sweeps + (start is not None), sweep, carry)
    return psi, begin


def orthonormal_rows(G: Float[Array, "row w"], n: int, two_n: int) -> Float[Array, "row w"]:
    """`G` with its first n rows made orthonormal, and the rows beyond orthogonal to them, in their
    first 2n columns: row operations, which keep the row space. Gram-Schmidt, hard rows first."""
    rows = []
    for i in range(G.shape[0]):
        row = G[i]
        for done in rows[: min(i, n)]:
            row = row - jnp.dot(row[:two_n], done[:two_n]) * done
        if i < n:
            size = jnp.sqrt(jnp.dot(row[:two_n], row[:two_n]))
            row = row / jnp.where(size > 0, size, 1.0)
        rows.append(row)
    return jnp.stack(rows)


def join(
    terminal: Float[Array, "row w"], transitions: Float[Array, "two_n w segment"], n: int
) -> Float[Array, "segment row w"]:
    """G at the segments' ends, from the end conditions `terminal` backwards."""
    two_n, w, segments = transitions.shape
    extra = jnp.concatenate(
        [jnp.zeros((w - two_n, two_n), terminal.dtype), jnp.eye(w - two_n, dtype=terminal.dtype)],
        axis=1,
    )
    extra = jnp.broadcast_to(extra[:, :, None], (w - two_n, w, segments))
    full = jnp.concatenate([transitions, extra]).transpose(2, 0, 1)
    groups = full.reshape(segments // GROUP, GROUP, w, w)

    def back(after: Array, here: Array) -> tuple[Array, Array]:
        now = after @ here
        return now, after

    eye = jnp.broadcast_to(jnp.eye(w, dtype=terminal.dtype), (groups.shape[0], w, w))
    whole, suffix = jax.lax.scan(back, eye, groups.transpose(1, 0, 2, 3), reverse=True)

    def step(G: Array, group: Array) -> tuple[Array, Array]:
        G = orthonormal_rows(G, n, two_n)
        return G @ group, G

    _, at_group_end = jax.lax.scan(step, terminal, whole, reverse=True)
    ends = at_group_end[:, None] @ suffix.transpose(1, 0, 2, 3)
    return ends.reshape(segments, terminal.shape[0], w)
