"""One Newton step of a transcription: its KKT system solved by elimination, segment by segment.

Within a segment the states follow from its start, its controls and the clock: one LU of the
defects' Jacobian. What is left, a quadratic in start, controls and clock, is minimised over the
controls from the last segment to the first (a Riccati sweep), carrying the global unknowns, the
final state and its multiplier as parameters. A small dense system of the global unknowns ends it.

The inertia of the whole is right, so that the step descends, if every Cholesky factorisation exists
and the last system has as many negative eigenvalues as multipliers (Haynsworth).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, lu_factor, lu_solve
from jaxtyping import Array, Bool, Float

from jaxguide.nominal.transcription import Ends, Nodes, Primal, Rows, Transcription

COMPLIANCE = 1e-8  # of path constraints: an equality is a spring of stiffness 1/this
_SOFT = 1e-11
_REFINEMENTS = 2


class System(NamedTuple):
    """The matrix: derivatives at the iterate, and the barrier's curvature."""

    nodes: Nodes
    ends: Ends
    node_hessian: Float[Array, "segment node in in"]
    end_hessian: Float[Array, "in in"]
    sigma: Primal  # z/(w - l) + z/(u - w)
    given: Primal  # bool: entries that must not move


class Load(NamedTuple):
    """The right-hand side, negated: the gradient without its constraint terms, and residuals."""

    force: Primal
    residual: Rows


class Step(NamedTuple):
    """Change of the unknowns, and the multipliers after it."""

    primal: Primal
    dual: Rows


class Segments(NamedTuple):
    """States after each segment's start, linear in v = (start, controls, clock, parameters)."""

    lu: Any
    X: Float[Array, "segment after n v"]
    T: Float[Array, "segment node in v"]  # the nodes' inputs
    extra: Float[Array, "segment row v"]
    extra_states: Float[Array, "segment row after_n"]


class _Stage(NamedTuple):
    """A segment of the backward sweep. theta = (start, times, p, xf, lambda_f)."""

    factor: Array  # Cholesky of the controls' Hessian
    N: Array
    KN: Array
    KE: Array
    small: Array
    D: Array
    E_u: Array
    E_t: Array
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


def over_segments(f: Any, items: Any) -> Any:
    """`f` of every segment in turn: LAPACK under `vmap` may hang, and gains nothing on CPU."""
    if jax.tree_util.tree_leaves(items)[0].shape[0] == 1:
        out = f(jax.tree_util.tree_map(lambda a: a[0], items))
        return jax.tree_util.tree_map(lambda a: a[None], out)
    return jax.lax.map(f, items)


def eliminate(program: Transcription, system: System) -> Segments:
    """States from the defects' linearisation, and what the extra rows then ask of the controls."""
    rule, size = program.rule, program.sizes
    n, C, dtype = size.n, size.nodes, system.sigma.x.dtype
    A, B = jnp.asarray(rule.A, dtype), jnp.asarray(rule.B, dtype)
    rows, support = A.shape
    diagonal = jnp.einsum("rp,ab->rapb", A, jnp.eye(n, dtype=dtype))
    own = slice(rule.first, rule.first + C)
    flat = lambda a: a.reshape(-1, a.shape[2])

    def one(F: Array) -> tuple:
        F = F[:, :n]
        G = diagonal.at[:, :, own].add(-jnp.einsum("rk,kab->rakb", B, F[:, :, :n]))
        to_u = -jnp.einsum("rk,kaj->rakj", B, F[:, :, n : n + size.m]).reshape(rows, n, -1)
        to_clock = -jnp.einsum("rk,kaj->raj", B, F[:, :, n + size.m :])
        right = jnp.concatenate([G[:, :, 0], to_u, to_clock], axis=2)
        G = G[:, :, 1:].reshape(rows, n, (support - 1) * n)
        lu = lu_factor(flat(G[rule.main]))
        X = -lu_solve(lu, flat(right[rule.main]))
        extra_states = flat(G[rule.extra])
        extra = flat(right[rule.extra]) + extra_states @ X
        return lu, X.reshape(support - 1, n, -1), extra, extra_states

    lu, X, extra, extra_states = over_segments(one, system.nodes.jacobian)
    # (x, u, clock, p) of every node from v.
    S, _, _, nv = X.shape
    m = size.m
    start = jnp.broadcast_to(jnp.eye(n, nv, dtype=dtype), (S, 1, n, nv))
    x = jnp.concatenate([start, X], axis=1)[:, own]
    rest = nv - n - C * m
    u = jnp.eye(C * m, nv, n, dtype=dtype).reshape(C, m, nv)
    clock = jnp.broadcast_to(jnp.eye(rest, nv, n + C * m, dtype=dtype), (C, rest, nv))
    same = jnp.broadcast_to(jnp.concatenate([u, clock], axis=1), (S, C, m + rest, nv))
    return Segments(lu, X, jnp.concatenate([x, same], axis=2), extra, extra_states)


def _spring(system: System) -> tuple[Array, Array]:
    """Stiffness of the path rows once their slacks are eliminated, and the slacks' share."""
    sigma, fixed = system.sigma.path, system.given.path
    flexible = jnp.where(fixed, 0.0, 1 / jnp.where(sigma > 0, sigma, 1.0))
    stiffness = jnp.where((sigma > 0) | fixed, 1 / (flexible + COMPLIANCE), 0.0)
    return stiffness, jnp.where(fixed, 0.0, 1 / (1 + COMPLIANCE * sigma))


def factorise(
    program: Transcription, system: System, segments: Segments, delta: Array, rho: Array
) -> tuple[Factor, Bool[Array, ""]]:
    """With `delta` I added to the Hessian; and whether its inertia is right."""
    size = program.sizes
    n, m, S = size.n, size.m, size.segments
    J, W = system.nodes.jacobian, system.node_hessian
    stiffness, _ = _spring(system)
    h_q = J[:, :, n + 1 :]
    W = W + jnp.einsum("skha,skh,skhb->skab", h_q, stiffness, h_q)
    # Barrier and regularisation of the controls; those of the states apply to all support points.
    diagonal = jnp.zeros(W.shape[:3], delta.dtype)
    diagonal = diagonal.at[:, :, n : n + m].set(system.sigma.u + delta)
    W = W + diagonal[..., None] * jnp.eye(W.shape[2], dtype=delta.dtype)[None, None]
    flat = lambda a: a.reshape(S, -1, a.shape[3])
    T, X = segments.T, segments.X
    H = jnp.einsum("siv,siw->svw", flat(T), flat(jnp.einsum("skab,skbv->skav", W, T)))
    H = H + jnp.einsum("siv,siw->svw", flat(X), flat((system.sigma.x + delta)[..., None] * X))
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
    n, nu, np_, dtype = size.n, size.nodes * size.m, size.parameters, H.dtype
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
        X, H, E, L = item
        X_u, X_t = X[:, controls], X[:, rest] @ L
        E_u, E_t = E[:, controls], E[:, rest] @ L
        ahead = jnp.eye(n_theta, dtype=dtype).at[:n].set(X_t)  # theta after the segment
        R = H[controls, controls] + X_u.T @ P[:n, :n] @ X_u + rho * (E_u.T @ E_u)
        N = H[controls][:, rest] @ L + X_u.T @ (P[:n] @ ahead) + rho * (E_u.T @ E_t)
        Q = L.T @ H[rest][:, rest] @ L + ahead.T @ P @ ahead + rho * (E_t.T @ E_t)
        factor = jnp.linalg.cholesky(R)
        ok = ok & jnp.all(jnp.isfinite(factor))
        solved = cho_solve((factor, True), jnp.concatenate([N, E_u.T], axis=1))
        KN, KE = solved[:, :n_theta], solved[:, n_theta:]
        Q = Q - N.T @ KN
        D = E_t - E_u @ KN
        small = jnp.zeros((0, 0), dtype)
        if E.shape[0]:
            gram = E_u @ KE
            # The floor only guards the rank of the extra rows.
            floor = 1e-14 * jnp.trace(gram) * jnp.eye(E.shape[0], dtype=dtype)
            small = jnp.linalg.cholesky(gram + floor)
            ok = ok & jnp.all(jnp.isfinite(small))
            Q = Q + D.T @ cho_solve((small, True), D)
        stage = _Stage(factor, N, KN, KE, small, D, E_u, E_t, X_u, X_t, L, P)
        return ((Q + Q.T) / 2, ok), stage

    items = (segments.X[:, -1], H, segments.extra, L)
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
    nu, np_ = C * m, size.parameters
    force, residual = load
    own = slice(rule.first, rule.first + C)
    h_q = system.nodes.jacobian[:, :, n + 1 :]
    stiffness, share = _spring(system)
    pushed = stiffness * residual.path + share * force.path

    # What the states are with all of v at zero, and the forces that this and the load leave.
    by_segment = lambda a: a.reshape(S, -1)
    main = by_segment(residual.defect[:, rule.main])
    x_bar = over_segments(lambda a: -lu_solve(a[0], a[1]), (segments.lu, main))
    e_bar = by_segment(residual.defect[:, rule.extra])
    e_bar = e_bar + jnp.einsum("sri,si->sr", segments.extra_states, x_bar)
    x_bar = x_bar.reshape(S, -1, n)
    at_nodes = jnp.pad(x_bar, ((0, 0), (1, 0), (0, 0)))[:, own]
    f = jnp.einsum("skab,skb->ska", factor.W[..., :n], at_nodes)
    f = f + jnp.einsum("skha,skh->ska", h_q, pushed)
    on_states = force.x + (system.sigma.x + factor.delta) * x_bar
    h = jnp.einsum("skav,ska->sv", segments.T, f)
    h = h + jnp.einsum("sknv,skn->sv", segments.X, on_states)
    h = h.at[:, n : n + nu].add(by_segment(force.u))

    # Backward: the linear part of the value.
    def back(p: Array, item: tuple) -> tuple[Array, tuple]:
        s, h, x_end, e = item
        ahead = p + s.P[:, :n] @ x_end
        rest = jnp.concatenate([h[:n], h[n + nu :]])
        h_u = h[n : n + nu] + s.X_u.T @ ahead[:n] + factor.rho * (s.E_u.T @ e)
        h_t = s.L.T @ rest + s.X_t.T @ ahead[:n] + ahead.at[:n].set(0.0)
        h_t = h_t + factor.rho * (s.E_t.T @ e)
        k = cho_solve((s.factor, True), h_u)
        d = e - s.E_u @ k
        out = h_t - s.N.T @ k
        if e.shape[0]:
            out = out + s.D.T @ cho_solve((s.small, True), d)
        return out, (k, d, p)

    zero = jnp.zeros(stages.P.shape[1], h.dtype)
    items = (stages, h, x_bar[:, -1], e_bar)
    p, (k, d, p_after) = jax.lax.scan(back, zero, items, reverse=True)

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
        s, X, x_end, k, d, p_after, c = item
        u = -(s.KN @ theta + k)
        eta = jnp.zeros(0, theta.dtype)
        if d.shape[0]:
            eta = cho_solve((s.small, True), s.D @ theta + d)
            u = u - s.KE @ eta
        v = jnp.concatenate([theta[:n], u, c @ theta[n : n + size.times], parameters])
        after = theta.at[:n].set(X @ v + x_end)
        return after, (v, eta, s.P[:n] @ after + p_after[:n])

    items = (stages, segments.X[:, -1], x_bar[:, -1], k, d, p_after, program.clocks)
    _, (v, eta, costate) = jax.lax.scan(forward, theta, items)
    dx = jnp.einsum("sknv,sv->skn", segments.X, v) + x_bar
    du = v[:, n : n + nu].reshape(S, C, m)
    dq = jnp.einsum("skav,sv->ska", segments.T, v).at[:, :, :n].add(at_nodes)

    # Multipliers of the main rows: the force on each state after the start must vanish.
    f = jnp.einsum("skab,skb->ska", factor.W[:, :, :n], dq)
    f = f + jnp.einsum("skha,skh->ska", h_q[..., :n], pushed)
    on_states = jnp.zeros((S, size.after + 1, n), h.dtype).at[:, own].set(f)[:, 1:]
    on_states = on_states + force.x + (system.sigma.x + factor.delta) * dx
    # Forces that a next segment's nodes put on a shared end are in its own value.
    on_states = by_segment(on_states.at[:, -1].add(costate))
    on_states = on_states + jnp.einsum("sri,sr->si", segments.extra_states, eta)
    main = over_segments(lambda a: lu_solve(a[0], -a[1], trans=1), (segments.lu, on_states))
    rows = jnp.zeros((S, rule.A.shape[0], n), h.dtype)
    rows = rows.at[:, rule.main].set(main.reshape(S, -1, n))
    rows = rows.at[:, rule.extra].set(eta.reshape(S, -1, n))

    # Path and endpoint slacks, from their rows.
    h_dq = jnp.einsum("skha,ska->skh", h_q, dq)
    path = stiffness * h_dq + pushed
    d_path = h_dq + residual.path - COMPLIANCE * path
    b = theta[: moving + n]
    d_end = system.ends.jacobian[1:] @ b + residual.end
    primal = Primal(
        theta[:n],
        dx,
        du,
        theta[n : n + size.times],
        parameters,
        jnp.where(system.given.path, 0.0, d_path),
        jnp.where(system.given.end, 0.0, d_end),
    )
    return Step(primal, Rows(rows, path, nu_))


def product(program: Transcription, system: System, delta: Array, step: Step) -> Load:
    """The matrix times a step, without elimination: what refinement measures by."""
    n = program.sizes.n
    dw, y = step
    J, rule = system.nodes.jacobian, program.rule
    A, B = (jnp.asarray(a, delta.dtype) for a in (rule.A, rule.B))
    dq, db = program.inputs(dw), program.end_inputs(dw)
    on_q, on_b, on_support = forces(program, system.nodes, system.ends, y, 0.0)
    on_q = on_q + jnp.einsum("skab,skb->ska", system.node_hessian, dq)
    on_b = on_b + system.end_hessian @ db
    force = gather(program, dw, on_q, on_b, on_support)
    springs = lambda f, s, d, g: jnp.where(g, 0.0, f + (s + delta) * d)
    own = jax.tree_util.tree_map(springs, force, system.sigma, dw, system.given)
    slack = lambda y, s, d, g: jnp.where(g, 0.0, -y + s * d)
    force = own._replace(
        path=slack(y.path, system.sigma.path, dw.path, system.given.path),
        end=slack(y.end, system.sigma.end, dw.end, system.given.end),
    )
    e_b = system.ends.jacobian[1:]
    defect = jnp.einsum("rp,spn->srn", A, program.support(dw))
    defect = defect - jnp.einsum("rk,skna,ska->srn", B, J[:, :, :n], dq)
    path = jnp.einsum("skha,ska->skh", J[:, :, n + 1 :], dq) - dw.path - COMPLIANCE * y.path
    return Load(force, Rows(defect, path, e_b @ db - dw.end))


def forces(
    program: Transcription, nodes: Nodes, ends: Ends, y: Rows, cost: float
) -> tuple[Array, Array, Array]:
    """Derivatives of `cost` f + y^T c by the nodes' inputs, the endpoint inputs and, of A X alone,
    the support points."""
    n = program.sizes.n
    weights = program.node_weights(y).at[:, :, n].set(cost)
    on_q = jnp.einsum("sko,skoa->ska", weights, nodes.jacobian)
    on_b = cost * ends.jacobian[0] + y.end @ ends.jacobian[1:]
    A = jnp.asarray(program.rule.A, y.defect.dtype)
    return on_q, on_b, jnp.einsum("rp,srn->spn", A, y.defect)


def gather(
    program: Transcription, like: Primal, on_q: Array, on_b: Array, on_support: Array
) -> Primal:
    """`forces` on the unknowns themselves."""

    def spread(w: Primal) -> tuple[Array, Array, Array]:
        return program.inputs(w), program.end_inputs(w), program.support(w)

    return jax.linear_transpose(spread, like)((on_q, on_b, on_support))[0]


def gradient(program: Transcription, nodes: Nodes, ends: Ends, w: Primal, y: Rows) -> Primal:
    """Of the Lagrangian f + y^T c, from Jacobians at hand."""
    on_unknowns = gather(program, w, *forces(program, nodes, ends, y, 1.0))
    return on_unknowns._replace(path=-y.path, end=-y.end)


def solve(
    program: Transcription, system: System, segments: Segments, factor: Factor, load: Load
) -> Step:
    """`apply`, refined: stiff barriers lose digits in the reduced Hessian, not in the product."""

    def refine(_: Any, step: Step) -> Step:
        got = product(program, system, factor.delta, step)
        left = jax.tree_util.tree_map(lambda a, b: a + b, load, got)
        better = apply(program, system, segments, factor, left)
        return jax.tree_util.tree_map(lambda a, b: a + b, step, better)

    # From nothing, so that the elimination is compiled once.
    blank = Step(load.force, load.residual)
    blank = jax.tree_util.tree_map(jnp.zeros_like, blank)
    return jax.lax.fori_loop(0, 1 + _REFINEMENTS, refine, blank)
