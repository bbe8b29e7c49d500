"""A neighbouring extremal from one time to another through a sweep: the history of a deviation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.linalg import gauss_solve
from jaxguide.neighboring.sweep import Sweep, orthonormal_rows


@jax.jit
def propagate(sweep: Sweep, t_from: Array, t_to: Array) -> Float[Array, "two_n n"]:
    """(dx, dlambda) at `t_to` per dx(t_from) on neighbouring extremals, segment by segment.

    Inside a segment y(r) = Psi(r)^-1 Psi(l) y(l), and Psi is symplectic: its inverse needs no
    solve. At each break y is put back on G y = 0, which keeps growing modes out. (Putting the
    costate back on S dx would do so too, but S may be infinite at the end.)
    """
    n = sweep.scale.shape[0] // 2
    two_n = 2 * n

    def step(y: Array, i: Array) -> tuple[Array, None]:
        l = jnp.clip(t_from, sweep.breaks[i], sweep.breaks[i + 1])
        r = jnp.clip(t_to, sweep.breaks[i], sweep.breaks[i + 1])
        left = sweep.transition(i, l)[:, :two_n]
        right = sweep.transition(i, r)[:, :two_n]
        G = sweep.ends[i][:n, :two_n] @ left
        rows = orthonormal_rows(G, n, two_n)
        start = jnp.concatenate([jnp.eye(n, dtype=G.dtype), -gauss_solve(G[:, n:], G[:, :n])])
        z = left @ jnp.where(i == first, start, y - rows.T @ (rows @ y))
        # The inverse of a symplectic [[a, b], [c, d]] is [[d^T, -b^T], [-c^T, a^T]].
        a, b, c, d = right[:n, :n], right[:n, n:], right[n:, :n], right[n:, n:]
        moved = jnp.concatenate([d.T @ z[:n] - b.T @ z[n:], a.T @ z[n:] - c.T @ z[:n]])
        return jnp.where((r > l) | (i == first), moved, y), None

    first = sweep.locate(t_from)
    start = jnp.eye(two_n, n, dtype=sweep.ends.dtype)
    y, _ = jax.lax.scan(step, start, jnp.arange(sweep.ends.shape[0], dtype=first.dtype))
    return sweep.scale[:, None] * y / sweep.scale[None, :n]
