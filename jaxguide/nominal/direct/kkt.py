"""One Newton step of a transcription: its KKT system solved by elimination, segment by segment.

Within a segment the defects leave a null space of start, clock and as many free directions as there
are controls: one LU factorisation of their transposed Jacobian. What is left, a quadratic in these,
is minimised over the free directions from the last segment to the first (a Riccati sweep), carrying
the global unknowns, the final state and its multiplier as parameters. A small dense system of the
globals ends it.

The inertia of the whole is right, so that the step descends, if every Cholesky factorisation exists
and the last system has as many negative eigenvalues as multipliers (Haynsworth).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float

from jaxguide.nominal.direct.elimination import (
    Segments,
    basic,
    gram,
    on_diagonal,
    over_segments,
    spring,
)
from jaxguide.nominal.direct.newton import COMPLIANCE, Load, Step, System, product
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal, Rows

_SOFT = 1e-11
_REFINEMENTS, _ENOUGH = 2, 1e-12


class _Stage(NamedTuple):
    """A segment of the backward sweep. theta = (start, times, p, xf, lambda_f)."""

    factor: Array  # Cholesky of the controls' Hessian
    N: Array
    KN: Array
    X_u: Array
    X_t: Array
    L: Array
    P: Array  # of the value after the segment


class Factor(NamedTuple):
    """Everything a right-hand side needs."""

    W: Float[Array, "segment node in in"]
    delta: Float[Array, ""]
    rho: Float[Array, ""]
    stages: _Stage
    eigenvalues: Float[Array, " k"]
    vectors: Float[Array, "k k"]
    equilibrium: Float[Array, " k"]
    K: Float[Array, "k k"]
    held: Bool[Array, " k"]


def factorise(
    program: Transcription, system: System, segments: Segments, delta: Array, rho: Array
) -> tuple[Factor, Bool[Array, ""]]:
    """With `delta` I added to the Hessian; and whether its inertia is right."""
    size = program.sizes
    n, W = size.n, segments.W
    everywhere = jnp.broadcast_to(delta, (*W.shape[:2], size.m))
    W = W + on_diagonal(everywhere, n, W.shape[2])
    regular = lambda: (
        segments.H + delta * (gram(segments.X, segments.X) + gram(segments.U, segments.U))
    )
    H = jax.lax.cond(delta > 0, regular, lambda: segments.H)
    stages, P, convex = _sweep(program, segments, H, rho)
    K, held = _globals(program, system, P, delta)
    size_ = jnp.sqrt(jnp.max(jnp.abs(K), axis=1) + 1e-300)
    scaled = K / size_[:, None] / size_[None, :]
    finite = jnp.all(jnp.isfinite(scaled))
    # Where the end is hardly within reach, or a constraint is redundant, its multiplier is soft;
    # refinement takes the softness out again.
    soft = jnp.arange(len(held)) >= len(held) - n - size.end
    scaled = scaled - jnp.diag(jnp.where(soft, _SOFT, 0.0))
    eye = jnp.eye(len(held), dtype=delta.dtype)
    eigenvalues, vectors = jnp.linalg.eigh(jnp.where(finite, scaled, eye))
    ok = convex & finite & (jnp.sum(eigenvalues < 0) == n + size.end)
    return Factor(W, delta, rho, stages, eigenvalues, vectors, size_, scaled, held), ok


def _sweep(
    program: Transcription, segments: Segments, H: Array, rho: Array
) -> tuple[_Stage, Array, Bool[Array, ""]]:
    """Minimises over the controls, last segment first."""
    size = program.sizes
    n, np_, dtype = size.n, size.parameters, H.dtype
    nu = H.shape[1] - n - 2 - np_
    nt = size.times
    n_theta = 3 * n + nt + np_
    own, xf = slice(0, n), slice(n + nt + np_, 2 * n + nt + np_)
    lam = slice(n_theta - n, n_theta)
    eye = jnp.eye(n, dtype=dtype)
    # V at the end: lambda_f^T (x - xf) + rho |x - xf|^2 / 2.
    P = jnp.zeros((n_theta, n_theta), dtype)
    P = P.at[own, own].set(rho * eye).at[xf, xf].set(rho * eye)
    P = P.at[own, xf].set(-rho * eye).at[xf, own].set(-rho * eye)
    P = P.at[own, lam].set(eye).at[lam, own].set(eye)
    P = P.at[xf, lam].set(-eye).at[lam, xf].set(-eye)
    # (start, clock, p) of a segment from theta.
    rest = jnp.concatenate([jnp.arange(n), jnp.arange(n + nu, n + nu + 2 + np_)])
    L = jnp.zeros((size.segments, n + 2 + np_, n_theta), dtype)
    L = L.at[:, :n, :n].set(eye)
    L = L.at[:, n : n + 2, n : n + nt].set(program.clocks)
    L = L.at[:, n + 2 :, n + nt : n + nt + np_].set(jnp.eye(np_, dtype=dtype))
    controls = slice(n, n + nu)

    def back(carry: tuple, item: tuple) -> tuple[tuple, _Stage]:
        P, ok = carry
        X, H, L = item
        X_u, X_t = X[:, controls], X[:, rest] @ L
        ahead = jnp.eye(n_theta, dtype=dtype).at[:n].set(X_t)  # theta after the segment
        R = H[controls, controls] + X_u.T @ P[:n, :n] @ X_u
        N = H[controls][:, rest] @ L + X_u.T @ (P[:n] @ ahead)
        Q = L.T @ H[rest][:, rest] @ L + ahead.T @ P @ ahead
        factor = jnp.linalg.cholesky(R)
        ok = ok & jnp.all(jnp.isfinite(factor))
        KN = cho_solve((factor, True), N)
        Q = Q - N.T @ KN
        stage = _Stage(factor, N, KN, X_u, X_t, L, P)
        return ((Q + Q.T) / 2, ok), stage

    items = (segments.X[:, -1], H, L)
    (P, ok), stages = jax.lax.scan(back, (P, jnp.array(True)), items, reverse=True)
    return stages, P, ok


def _globals(
    program: Transcription, system: System, P: Array, delta: Array
) -> tuple[Array, Bool[Array, " k"]]:
    """The matrix of (x0, times, p, xf, lambda_f, nu), and which of them are held."""
    size = program.sizes
    n, q, dtype = size.n, size.end, P.dtype
    moving = n + size.times + size.parameters  # x0, times, p
    nb = moving + n  # and xf
    join = lambda w: jnp.concatenate([w.x0, w.times, w.p])
    given = join(system.given)
    e_b = system.ends.jacobian[1:]
    K = jnp.zeros((nb + n + q, nb + n + q), dtype).at[: nb + n, : nb + n].add(P)
    K = K.at[:nb, :nb].add(system.end_hessian)
    own = jnp.where(given, 0.0, join(system.sigma)) + delta  # of xf, a state, the segment has it
    K = K.at[:moving, :moving].add(jnp.diag(own))
    K = K.at[nb + n :, :nb].set(e_b).at[:nb, nb + n :].set(e_b.T)
    K = K.at[nb + n :, nb + n :].set(-jnp.diag(_flexibility(system)))
    held = jnp.concatenate([given, jnp.zeros(nb + n + q - moving, bool)])
    return jnp.where(held[:, None] | held[None, :], jnp.eye(len(held), dtype=dtype), K), held


def _flexibility(system: System) -> Array:
    """1/Sigma of the endpoint slacks; none where they are given."""
    return jnp.where(system.given.end, 0.0, 1 / jnp.maximum(system.sigma.end, 1e-12))


def apply(
    program: Transcription, system: System, segments: Segments, factor: Factor, load: Load
) -> Step:
    """The solution for one right-hand side."""
    size, rule, stages = program.sizes, program.rule, factor.stages
    n, m, S, C = size.n, size.m, size.segments, size.nodes
    np_ = size.parameters
    force, residual = load
    force = force._replace(u=jnp.where(system.given.u, 0.0, force.u))
    own = slice(rule.first, rule.first + C)
    h_q = system.nodes.jacobian[:, :, n + 1 :]
    stiffness, share = spring(system)
    pushed = stiffness * residual.path + share * force.path

    # What the states are with all of v at zero, and the forces that this and the load leave.
    by_segment = lambda a: a.reshape(S, -1)
    xu = lambda x, u: jnp.concatenate([by_segment(x), by_segment(u)], axis=1)
    apart = lambda a: (
        a[:, : size.after * n].reshape(S, -1, n),
        a[:, size.after * n :].reshape(S, C, m),
    )

    def particular(item: tuple) -> Array:
        basis, _, place, weight, c = item
        moved = jnp.zeros_like(weight).at[: len(c)].set(-basic(basis, c))
        return moved[place] / weight

    factors = (segments.basis, segments.order, segments.place, segments.size)
    x_bar, u_bar = apart(over_segments(particular, (*factors, by_segment(residual.defect))))
    at_nodes = jnp.pad(x_bar, ((0, 0), (1, 0), (0, 0)))[:, own]
    at_nodes = jnp.concatenate([at_nodes, u_bar], axis=2)
    f = jnp.einsum("skab,skb->ska", factor.W[..., : n + m], at_nodes)
    f = f.at[:, :, n : n + m].add(program.roughness(u_bar))
    f = f + jnp.einsum("skha,skh->ska", h_q, pushed)
    on_states = force.x + (system.sigma.x + factor.delta) * x_bar
    h = jnp.einsum("skav,ska->sv", segments.T, f)
    h = h + jnp.einsum("sknv,skn->sv", segments.X, on_states)
    h = h + jnp.einsum("skmv,skm->sv", segments.U, force.u)
    nu = h.shape[1] - n - 2 - np_

    # Backward: the linear part of the value.
    def back(p: Array, item: tuple) -> tuple[Array, tuple]:
        s, h, x_end = item
        ahead = p + s.P[:, :n] @ x_end
        rest = jnp.concatenate([h[:n], h[n + nu :]])
        h_u = h[n : n + nu] + s.X_u.T @ ahead[:n]
        h_t = s.L.T @ rest + s.X_t.T @ ahead[:n] + ahead.at[:n].set(0.0)
        k = cho_solve((s.factor, True), h_u)
        return h_t - s.N.T @ k, (k, p)

    zero = jnp.zeros(stages.P.shape[1], h.dtype)
    items = (stages, h, x_bar[:, -1])
    p, (k, p_after) = jax.lax.scan(back, zero, items, reverse=True)

    # The global unknowns.
    moving = n + size.times + np_
    own_force = jnp.concatenate([force.x0, force.times, force.p])
    p = p.at[:moving].add(own_force)
    pulled = jnp.where(system.given.end, 0.0, _flexibility(system) * force.end)
    rhs = -jnp.concatenate([p, residual.end + pulled])
    rhs = jnp.where(factor.held, 0.0, rhs) / factor.equilibrium
    invert = lambda r: factor.vectors @ ((factor.vectors.T @ r) / factor.eigenvalues)
    solution = invert(rhs)
    solution = (solution + invert(rhs - factor.K @ solution)) / factor.equilibrium
    theta, nu_ = solution[: len(p)], solution[len(p) :]
    parameters = theta[n + size.times : moving]

    # Forward.
    def forward(theta: Array, item: tuple) -> tuple[Array, tuple]:
        s, X, x_end, k, p_after, c = item
        z = -(s.KN @ theta + k)
        v = jnp.concatenate([theta[:n], z, c @ theta[n : n + size.times], parameters])
        after = theta.at[:n].set(X @ v + x_end)
        return after, (v, s.P[:n] @ after + p_after[:n])

    items = (stages, segments.X[:, -1], x_bar[:, -1], k, p_after, program.clocks)
    _, (v, costate) = jax.lax.scan(forward, theta, items)
    dx = jnp.einsum("sknv,sv->skn", segments.X, v) + x_bar
    du = jnp.einsum("skmv,sv->skm", segments.U, v) + u_bar
    dq = jnp.einsum("skav,sv->ska", segments.T, v).at[:, :, : n + m].add(at_nodes)

    # Multipliers of the defects: the force on each state after the start, and control, must vanish.
    f = jnp.einsum("skab,skb->ska", factor.W[:, :, : n + m], dq)
    f = f.at[:, :, n:].add(program.roughness(du))
    f = f + jnp.einsum("skha,skh->ska", h_q[..., : n + m], pushed)
    on_states = jnp.zeros((S, size.after + 1, n), h.dtype).at[:, own].set(f[..., :n])[:, 1:]
    on_states = on_states + force.x + (system.sigma.x + factor.delta) * dx
    # Forces that a next segment's nodes put on a shared end are in its own value.
    on_states = on_states.at[:, -1].add(costate)

    def covector(item: tuple) -> Array:
        basis, order, _, weight, f = item
        f = (f / weight)[order[: len(basis)]]
        f = solve_triangular(basis, f, lower=True, unit_diagonal=True)
        return -solve_triangular(basis, f)

    rows = over_segments(covector, (*factors, xu(on_states, f[..., n:] + force.u)))
    rows = rows.reshape(S, -1, n)

    # Path and endpoint slacks, from their rows.
    h_dq = jnp.einsum("skha,ska->skh", h_q, dq)
    path = stiffness * h_dq + pushed
    d_path = h_dq + residual.path - COMPLIANCE * path
    b = theta[: moving + n]
    d_end = system.ends.jacobian[1:] @ b + residual.end
    primal = Primal(
        theta[:n],
        dx,
        jnp.where(system.given.u, 0.0, du),
        theta[n : n + size.times],
        parameters,
        jnp.where(system.given.path, 0.0, d_path),
        jnp.where(system.given.end, 0.0, d_end),
    )
    return Step(primal, Rows(rows, path, nu_))


def solve(
    program: Transcription, system: System, segments: Segments, factor: Factor, load: Load
) -> Step:
    """`apply`, refined where it needs to be: stiff barriers lose digits in the reduced Hessian, not
    in the product. A Newton step that leaves a millionth of the constraints loses nothing."""
    largest = lambda tree: jnp.max(jnp.stack([
        jnp.max(jnp.abs(a), initial=0.0) for a in jax.tree_util.tree_leaves(tree)
    ]))  # fmt: skip
    add = lambda a, b: jax.tree_util.tree_map(jnp.add, a, b)
    enough_force = _ENOUGH * jnp.maximum(1.0, largest(load.force))
    enough_rows = 1e-6 * largest(load.residual) + 1e-15

    def refine(carry: tuple) -> tuple:
        count, step, left, _ = carry
        step = add(step, apply(program, system, segments, factor, left))
        left = add(load, product(program, system, factor.delta, step))
        good = (largest(left.force) <= enough_force) & (largest(left.residual) <= enough_rows)
        return count + 1, step, left, good

    blank = jax.tree_util.tree_map(jnp.zeros_like, Step(load.force, load.residual))
    return jax.lax.while_loop(
        lambda a: ~a[3] & (a[0] <= _REFINEMENTS), refine, (0, blank, load, jnp.array(False))
    )[1]
