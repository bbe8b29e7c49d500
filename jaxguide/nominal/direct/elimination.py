"""States and controls of each segment eliminated by its defects: a smaller quadratic is left.

Within a segment the defects leave a null space of the start, the clock, the static parameters and
as many free directions z as there are controls. It is found by one LU factorisation of the defects'
transposed Jacobian.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxguide.arrays import Array, added, on_numpy, one_by_one, pivoted_lu, solve_triangular, xp
from jaxguide.nominal.direct.newton_system import COMPLIANCE, NewtonSystem
from jaxguide.nominal.direct.transcription import Transcription

# Barrier curvature that stands for a given control. Chosen, not tuned: its square root, by which
# the control's column is divided, is 1e8, so that the control moves by rounding alone.
_STIFF = 1e16


class Segments(NamedTuple):
    """States and controls after each segment's start, linear in v = (start, z, clock, parameters).
    z are the entries that the defects leave free, scaled by `size`.

    - `basis`: L and U of the basic entries, which the defects determine.
    - `order`: entries of (x, u), the basic ones first; `place`: where in that order an entry is.
    - `X`, `U`, `T`: states, controls and the nodes' inputs, from v.
    - `W`: Hessian, springs and barrier of the nodes' inputs.
    - `H`: the same, and the barrier of the states, as a quadratic of v.
    """

    basis: Float[Array, "segment row row"]
    order: Int[Array, "segment xu"]
    place: Int[Array, "segment xu"]
    size: Float[Array, "segment xu"]
    X: Float[Array, "segment after n v"]
    U: Float[Array, "segment node m v"]
    T: Float[Array, "segment node in v"]
    W: Float[Array, "segment node in in"]
    H: Float[Array, "segment v v"]


def over_segments(f: Any, items: Any) -> Any:
    """`f` of every segment in turn: LAPACK under `vmap` may hang, and gains nothing on CPU. On the
    host `f` takes all segments at once, so it is written for any leading axes."""
    if on_numpy(*jax.tree_util.tree_leaves(items)):
        return f(items)
    if jax.tree_util.tree_leaves(items)[0].shape[0] == 1:
        out = f(jax.tree_util.tree_map(lambda a: a[0], items))
        return jax.tree_util.tree_map(lambda a: a[None], out)
    return one_by_one(f, items)


def eliminate(program: Transcription, system: NewtonSystem) -> Segments:
    """The null space of the defects, and the quadratic restricted to it.

    The LU is stable however unstable the dynamics are; following the states from their start would
    not be. Pivoting, over states and controls alike, makes those entries basic that the defects
    determine best.
    """
    rule, counts, dtype = program.rule, program.counts, system.sigma.x.dtype
    n, m, C, S = counts.n, counts.m, counts.nodes, counts.segments
    support = len(rule.support)
    # Entries that a barrier holds count for little, so that the reduced Hessian is well scaled.
    flat = lambda x, u: xp.concatenate([x.reshape(S, -1), u.reshape(S, -1)], axis=1)
    weight = xp.sqrt(1 + flat(system.sigma.x, _on_controls(system)))
    A = xp.asarray(rule.A, dtype)
    diagonal = xp.einsum("rp,ab->rapb", A, xp.eye(n, dtype=dtype))  # of A X
    one = lambda item: _null_space(program, diagonal, *item)  # of any leading axes
    basis, order, place, V = over_segments(one, (system.nodes.jacobian, weight))

    nv = V.shape[2]
    split = (support - 1) * n
    X, U = V[:, :split].reshape(S, support - 1, n, nv), V[:, split:].reshape(S, C, m, nv)
    start = xp.broadcast_to(xp.eye(n, nv, dtype=dtype), (S, 1, n, nv))
    x = xp.concatenate([start, X], axis=1)[:, rule.first : rule.first + C]
    rest = system.nodes.jacobian.shape[3] - n - m
    clock = xp.broadcast_to(xp.eye(rest, nv, nv - rest, dtype=dtype), (S, C, rest, nv))
    T = xp.concatenate([x, U, clock], axis=2)
    return Segments(basis, order, place, weight, X, U, T, *_quadratic(program, system, X, U, T))


def _null_space(
    program: Transcription, diagonal: Array, jacobian: Array, weight: Array
) -> tuple[Array, Array, Array, Array]:
    """`basis`, `order` and `place` of one segment, see Segments, and (x, u) from v."""
    rule, n, m, C = program.rule, program.counts.n, program.counts.m, program.counts.nodes
    dtype, lead = weight.dtype, weight.shape[:-1]
    B = xp.asarray(rule.B, dtype)
    own = slice(rule.first, rule.first + C)
    rows = rule.A.shape[0] * n
    # The defects' Jacobian by states, controls, clock and parameters: of A X - B F.
    F = jacobian[..., :n, :]
    G = xp.broadcast_to(diagonal, (*lead, *diagonal.shape))
    G = added(G, np.s_[..., own, :], -xp.einsum("rk,...kab->...rakb", B, F[..., :n]))
    to_u = -xp.einsum("rk,...kaj->...rakj", B, F[..., n : n + m]).reshape(*lead, rows, -1)
    to_clock = -xp.einsum("rk,...kaj->...raj", B, F[..., n + m :]).reshape(*lead, rows, -1)
    start = G[..., 0, :].reshape(*lead, rows, n)
    G = xp.concatenate([G[..., 1:, :].reshape(*lead, rows, -1), to_u], axis=-1)
    G = G / weight[..., None, :]

    lu, order = _lu_with_order(xp.swapaxes(G, -1, -2))
    basis = lu[..., :rows, :]
    place = xp.argsort(order, axis=-1)
    # Basic entries from the free ones, and from start, clock and parameters.
    rest = xp.swapaxes(lu[..., rows:, :], -1, -2)
    free = -solve_triangular(basis, rest, trans=1, lower=True, unit_diagonal=True)
    follow = -basic_entries(basis, xp.concatenate([start, to_clock], axis=-1))
    k = free.shape[-1]
    one = xp.eye(k, follow.shape[-1] + k, n, dtype=dtype)
    V = xp.concatenate([
        xp.concatenate([follow[..., :n], free, follow[..., n:]], axis=-1),
        xp.broadcast_to(one, (*lead, *one.shape)),
    ], axis=-2)  # fmt: skip
    V = xp.take_along_axis(V, place[..., None], axis=-2)
    return basis, order, place, V / weight[..., None]


def _quadratic(
    program: Transcription, system: NewtonSystem, X: Array, U: Array, T: Array
) -> tuple[Array, Array]:
    """`W` and `H` of Segments."""
    rule, n, inputs = program.rule, program.counts.n, T.shape[2]
    stiffness, _ = path_springs(system)
    h_q = system.nodes.jacobian[:, :, n + 1 :]
    W = system.node_hessian + xp.swapaxes(h_q, 2, 3) @ (stiffness[..., None] * h_q)
    W = W + on_diagonal(_on_controls(system), n, inputs)
    # Where every point after the first is a node, its barrier joins the node's own Hessian.
    sigma = xp.pad(system.sigma.x, ((0, 0), (1, 0), (0, 0)))
    own = slice(rule.first, rule.first + program.points)
    if own.stop == sigma.shape[1]:
        H = gram(T, _times(W + on_diagonal(sigma[:, own], 0, inputs), T))
    else:
        H = gram(T, _times(W, T)) + gram(X, system.sigma.x[..., None] * X)
    if program.arcwise is not None:
        H = H + gram(U, program.roughness(U))
    return W, H


def _times(W: Array, T: Array) -> Array:
    return W @ T


def gram(
    a: Float[Array, "segment point k v"], b: Float[Array, "segment point k v"]
) -> Float[Array, "segment v v"]:
    """a^T b of every segment, summed over its points and their entries."""
    flat = lambda a: a.reshape(a.shape[0], -1, a.shape[3])
    return xp.swapaxes(flat(a), 1, 2) @ flat(b)


def on_diagonal(
    diagonal: Float[Array, "segment node k"], first: int, inputs: int
) -> Float[Array, "segment node in in"]:
    """A diagonal matrix for each node, of all its `inputs`: `diagonal` from entry `first` on, zero
    elsewhere."""
    room = (first, inputs - first - diagonal.shape[2])
    whole = xp.pad(diagonal, ((0, 0), (0, 0), room))
    return whole[..., None] * xp.eye(inputs, dtype=diagonal.dtype)[None, None]


def _lu_with_order(
    a: Float[Array, "*segment row column"],
) -> tuple[Array, Int[Array, "*segment row"]]:
    """L and U, in one array, of the rows of `a`, and the `order` of rows that pivoting chose.

    The order is read off a further column, which holds the rows' numbers: (L U)_last, rounded. XLA
    finds it from LAPACK's exchanges one by one, which took longer than the factorisation.
    """
    if on_numpy(a):
        return pivoted_lu(a)
    rows, columns = a.shape
    numbers = xp.arange(rows, dtype=a.dtype)[:, None]
    lu = jax.lax.linalg.lu(xp.concatenate([a, numbers], axis=1))[0]
    k = min(rows, columns + 1)
    lower = xp.tril(lu[:, :k], -1) + xp.eye(rows, k, dtype=a.dtype)
    order = xp.round(lower @ lu[:k, columns])
    return lu[:, :columns], xp.clip(order, 0, rows - 1).astype(xp.int32)


def basic_entries(basis: Float[Array, "*segment row row"], b: Array) -> Array:
    """The basic entries that make the defects `b` (*segment, row) or (*segment, row, k), the free
    ones being zero."""
    y = solve_triangular(basis, b, trans=1)
    return solve_triangular(basis, y, trans=1, lower=True, unit_diagonal=True)


def _on_controls(system: NewtonSystem) -> Array:
    """Barrier curvature of the controls; given ones hardly move."""
    return xp.where(system.given.u, _STIFF, system.sigma.u)


def path_springs(
    system: NewtonSystem,
) -> tuple[Float[Array, "segment node h"], Float[Array, "segment node h"]]:
    """Stiffness of the path constraints once their slacks are eliminated, and the share of a force
    on a slack that reaches the constraint."""
    sigma, fixed = system.sigma.path, system.given.path
    flexible = xp.where(fixed, 0.0, 1 / xp.where(sigma > 0, sigma, 1.0))
    stiffness = xp.where((sigma > 0) | fixed, 1 / (flexible + COMPLIANCE), 0.0)
    return stiffness, xp.where(fixed, 0.0, 1 / (1 + COMPLIANCE * sigma))
