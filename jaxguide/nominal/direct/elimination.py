"""States and controls of each segment eliminated by its defects: what is left is a quadratic."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from jaxguide.nominal.direct.newton import COMPLIANCE, System
from jaxguide.nominal.direct.transcription import Transcription

_STIFF = 1e16  # of what holds a given control


class Segments(NamedTuple):
    """States and controls after each segment's start, linear in v = (start, z, clock, parameters),
    where z are the entries that the defects leave free, scaled by `size`."""

    basis: Float[Array, "segment row row"]  # L and U of the basic entries
    order: Int[Array, "segment xu"]  # the basic entries first
    place: Int[Array, "segment xu"]  # where in that order an entry is
    size: Float[Array, "segment xu"]
    X: Float[Array, "segment after n v"]
    U: Float[Array, "segment node m v"]
    T: Float[Array, "segment node in v"]  # the nodes' inputs
    W: Float[Array, "segment node in in"]  # Hessian, springs and barrier of the nodes' inputs
    H: Float[Array, "segment v v"]  # the same, and the barrier of the states, of v


def over_segments(f: Any, items: Any) -> Any:
    """`f` of every segment in turn: LAPACK under `vmap` may hang, and gains nothing on CPU."""
    if jax.tree_util.tree_leaves(items)[0].shape[0] == 1:
        out = f(jax.tree_util.tree_map(lambda a: a[0], items))
        return jax.tree_util.tree_map(lambda a: a[None], out)
    return jax.lax.map(f, items)


def eliminate(program: Transcription, system: System) -> Segments:
    """The defects' null space, by LU: stable however unstable the dynamics are, where following
    the states from their start would not be: of states and controls alike, pivoting makes those
    basic that the defects determine best."""
    rule, size = program.rule, program.sizes
    n, m, C, S, dtype = size.n, size.m, size.nodes, size.segments, system.sigma.x.dtype
    A, B = jnp.asarray(rule.A, dtype), jnp.asarray(rule.B, dtype)
    rows, support = A.shape
    diagonal = jnp.einsum("rp,ab->rapb", A, jnp.eye(n, dtype=dtype))
    own = slice(rule.first, rule.first + C)
    count = rows * n
    # Entries that a barrier holds count for little, so that the reduced Hessian is well scaled.
    flat = lambda x, u: jnp.concatenate([x.reshape(S, -1), u.reshape(S, -1)], axis=1)
    weight = jnp.sqrt(1 + flat(system.sigma.x, _on_controls(system)))

    def one(item: tuple) -> tuple:
        F, weight = item
        F = F[:, :n]
        G = diagonal.at[:, :, own].add(-jnp.einsum("rk,kab->rakb", B, F[:, :, :n]))
        to_u = -jnp.einsum("rk,kaj->rakj", B, F[:, :, n : n + m]).reshape(count, -1)
        to_clock = -jnp.einsum("rk,kaj->raj", B, F[:, :, n + m :]).reshape(count, -1)
        start, G = G[:, :, 0].reshape(count, n), G[:, :, 1:].reshape(count, -1)
        G = jnp.concatenate([G, to_u], axis=1) / weight[None]
        lu, order = _lu_with_order(G.T)
        basis = lu[:count]
        place = jnp.zeros_like(order).at[order].set(jnp.arange(len(order), dtype=order.dtype))
        free = -solve_triangular(basis, lu[count:].T, trans=1, lower=True, unit_diagonal=True)
        follow = -basic(basis, jnp.concatenate([start, to_clock], axis=1))
        one = jnp.eye(free.shape[1], dtype=dtype)
        V = jnp.concatenate([
            jnp.concatenate([follow[:, :n], free, follow[:, n:]], axis=1),
            jnp.pad(one, ((0, 0), (n, follow.shape[1] - n))),
        ])[place]  # fmt: skip
        return basis, order, place, V / weight[:, None]

    basis, order, place, V = over_segments(one, (system.nodes.jacobian, weight))
    nv = V.shape[2]
    split = (support - 1) * n
    X, U = V[:, :split].reshape(S, support - 1, n, nv), V[:, split:].reshape(S, C, m, nv)
    start = jnp.broadcast_to(jnp.eye(n, nv, dtype=dtype), (S, 1, n, nv))
    x = jnp.concatenate([start, X], axis=1)[:, own]
    rest = system.nodes.jacobian.shape[3] - n - m
    clock = jnp.broadcast_to(jnp.eye(rest, nv, nv - rest, dtype=dtype), (S, C, rest, nv))
    T = jnp.concatenate([x, U, clock], axis=2)
    return Segments(basis, order, place, weight, X, U, T, *_quadratic(program, system, X, U, T))


def _quadratic(
    program: Transcription, system: System, X: Array, U: Array, T: Array
) -> tuple[Array, Array]:
    """`W` and `H` of Segments."""
    rule, n, inputs = program.rule, program.sizes.n, T.shape[2]
    stiffness, _ = spring(system)
    h_q = system.nodes.jacobian[:, :, n + 1 :]
    W = system.node_hessian + jnp.einsum("skha,skh,skhb->skab", h_q, stiffness, h_q)
    W = W + on_diagonal(_on_controls(system), n, inputs)
    # Where every point after the first is a node, its barrier joins the node's own Hessian.
    sigma = jnp.pad(system.sigma.x, ((0, 0), (1, 0), (0, 0)))
    own = slice(rule.first, rule.first + program.points)
    if own.stop == sigma.shape[1]:
        H = gram(T, _times(W + on_diagonal(sigma[:, own], 0, inputs), T))
    else:
        H = gram(T, _times(W, T)) + gram(X, system.sigma.x[..., None] * X)
    if program.arcwise is not None:
        of_columns = jax.vmap(program.roughness, in_axes=3, out_axes=3)
        H = H + gram(U, of_columns(U))
    return W, H


def _times(W: Array, T: Array) -> Array:
    return jnp.einsum("skab,skbv->skav", W, T)


def gram(a: Array, b: Array) -> Float[Array, "segment v v"]:
    flat = lambda a: a.reshape(a.shape[0], -1, a.shape[3])
    return jnp.einsum("siv,siw->svw", flat(a), flat(b))


def on_diagonal(diagonal: Float[Array, "segment node k"], first: int, inputs: int) -> Array:
    """`diagonal` of some of each node's inputs as a matrix of all of them."""
    room = (first, inputs - first - diagonal.shape[2])
    whole = jnp.pad(diagonal, ((0, 0), (0, 0), room))
    return whole[..., None] * jnp.eye(inputs, dtype=diagonal.dtype)[None, None]


def _lu_with_order(a: Float[Array, "row column"]) -> tuple[Array, Int[Array, " row"]]:
    """L and U of the rows of `a` in the `order` that pivoting gives them, in one array.

    The order is read off a further column, which holds the rows' numbers: (L U)_last, rounded. XLA
    finds it from LAPACK's exchanges one by one, which took longer than the factorisation.
    """
    rows, columns = a.shape
    numbers = jnp.arange(rows, dtype=a.dtype)[:, None]
    lu = jax.lax.linalg.lu(jnp.concatenate([a, numbers], axis=1))[0]
    k = min(rows, columns + 1)
    lower = jnp.tril(lu[:, :k], -1) + jnp.eye(rows, k, dtype=a.dtype)
    order = jnp.round(lower @ lu[:k, columns])
    return lu[:, :columns], jnp.clip(order, 0, rows - 1).astype(jnp.int32)


def basic(basis: Array, b: Array) -> Array:
    """The basic entries that make the defects `b`, the others zero."""
    y = solve_triangular(basis, b, trans=1)
    return solve_triangular(basis, y, trans=1, lower=True, unit_diagonal=True)


def _on_controls(system: System) -> Array:
    """Barrier curvature of the controls; given ones hardly move."""
    return jnp.where(system.given.u, _STIFF, system.sigma.u)


def spring(system: System) -> tuple[Array, Array]:
    """Stiffness of the path rows once their slacks are eliminated, and the slacks' share."""
    sigma, fixed = system.sigma.path, system.given.path
    flexible = jnp.where(fixed, 0.0, 1 / jnp.where(sigma > 0, sigma, 1.0))
    stiffness = jnp.where((sigma > 0) | fixed, 1 / (flexible + COMPLIANCE), 0.0)
    return stiffness, jnp.where(fixed, 0.0, 1 / (1 + COMPLIANCE * sigma))
