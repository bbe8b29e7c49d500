"""Small dense linear algebra without LAPACK: it vectorises, and cannot hang under `vmap`.

On CPU a `vmap` over LAPACK calls runs them one by one and has deadlocked at batch 64; on GPU
batched QR is a loop. The matrices of guidance are small (2n by 2n), so elimination by hand wins.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Up to this size elimination is unrolled, so that XLA fuses it: by experiment on the 2n x 2n
# matrices of guidance, run time against the time to compile.
_UNROLL = 8


def _eliminate(k: Any, ab: Array) -> Array:
    """One Gauss-Jordan step on column `k` of the augmented `ab`, with partial pivoting."""
    n = ab.shape[0]
    rows = jnp.arange(n)
    column = jnp.where(rows >= k, jnp.abs(ab[:, k]), -1.0)
    p = jnp.argmax(column)
    pivot_row, other = ab[p], ab[k]
    pivot_row = pivot_row / pivot_row[k]
    ab = jnp.where((rows == p)[:, None], other[None, :], ab)
    factor = jnp.where(rows == k, 0.0, ab[:, k])
    ab = ab - factor[:, None] * pivot_row[None, :]
    return jnp.where((rows == k)[:, None], pivot_row[None, :], ab)


@jax.jit
def _gauss(a: Array, b: Array) -> Array:
    n = a.shape[0]
    ab = jnp.concatenate([a, b], axis=1)
    if n <= _UNROLL:
        for k in range(n):
            ab = _eliminate(k, ab)
    else:
        ab = jax.lax.fori_loop(0, n, _eliminate, ab)
    return ab[:, n:]


@jax.jit
def gauss_solve(a: Float[Array, "n n"], b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """`a^-1 b` by Gauss-Jordan elimination with partial pivoting.

    Derivatives are those of the linear system (`lax.custom_linear_solve`), not of the elimination.

    **Arguments:** `a`: nonsingular; `b`: vector or matrix.

    **Returns:** the solution, of the shape of `b`. A singular `a` gives inf or NaN, never a
    silently truncated answer.

    **Error:** backward stable in practice for the n <= 100 that occur here.

    **Source:** Higham, *Accuracy and Stability of Numerical Algorithms* (2002), section 14.4.
    """
    matrix = b if b.ndim == 2 else b[:, None]
    out = jax.lax.custom_linear_solve(
        lambda x: a @ x,
        matrix,
        lambda _, rhs: _gauss(jax.lax.stop_gradient(a), rhs),
        lambda _, rhs: _gauss(jax.lax.stop_gradient(a).T, rhs),
    )
    return out if b.ndim == 2 else out[:, 0]


@jax.jit
def cholesky_positive(a: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Whether the symmetric `a` is positive definite, by the signs of its elimination pivots.

    NaN counts as not positive definite.

    **Source:** Higham, *Accuracy and Stability of Numerical Algorithms* (2002), section 10.1.
    """
    ok = jnp.array(True)
    for k in range(a.shape[0]):
        ok = ok & (a[k, k] > 0)
        a = a - jnp.outer(a[:, k], a[k]) / jnp.where(a[k, k] == 0, 1.0, a[k, k])
    return ok


def left_null_space(
    a: Float[Array, "rows cols"],
) -> tuple[Float[Array, "null rows"], Float[Array, "cols rows"]]:
    r"""A basis `N` of the left null space of `a`, and a left inverse `L`: `N @ a = 0`, `L @ a = I`.

    By Gauss-Jordan elimination with pivoting over the rows of `a`. Both are in reduced form: each
    row of `N` has a one at a row of `a` that was no pivot, and zeros at the other such rows. This
    basis, not an orthonormal one, results when the multipliers $\nu$ are eliminated by hand.

    **Arguments:** `a`: of full column rank; else inf or NaN.

    **Returns:** `N` (rows - cols, rows) and `L` (cols, rows).
    """
    rows, cols = a.shape
    if cols == 0:
        return jnp.eye(rows, dtype=a.dtype), jnp.zeros((0, rows), a.dtype)
    index = jnp.arange(rows)
    work = jnp.concatenate([a.T, jnp.eye(cols, dtype=a.dtype)], axis=1)  # row operations on a^T
    free = jnp.ones(rows, bool)
    picks = []
    for k in range(cols):
        scores = jnp.where(free, jnp.abs(work[k, :rows]), -1.0)
        p = jnp.argmax(scores)
        free = free & (index != p)
        picks.append(p)
        pivot = work[k] / work[k][p]
        factor = jnp.where(jnp.arange(cols) == k, 0.0, work[:, p])
        work = work - factor[:, None] * pivot[None, :]
        work = jnp.where((jnp.arange(cols) == k)[:, None], pivot[None, :], work)
    # a^T = T^-1 reduced; reduced[k] has 1 at picks[k], 0 at the other picks.
    onehot = jnp.stack([(index == p).astype(a.dtype) for p in picks], 0).reshape(cols, rows)
    reduced, t = work[:, :rows], work[:, rows:]
    basis = jnp.eye(rows, dtype=a.dtype) - reduced.T @ onehot  # row r: e_r - sum reduced[k,r] e_pk
    order = jnp.argsort(jnp.where(free, index, rows + index))[: rows - cols]
    return basis[order], t.T @ onehot


def power_of_two(size: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The power of two nearest to `size` (1 where that is 0 or not finite): a unit by which nothing
    is rounded."""
    usable = (size > 0) & jnp.isfinite(size)
    exponent = jnp.round(jnp.log2(jnp.where(usable, size, 1.0))).astype(jnp.int32)
    return jnp.where(usable, jnp.ldexp(jnp.ones_like(size), exponent), 1.0)
