"""One Newton step of a transcription: its KKT system solved by elimination, segment by segment.

Within a segment the states follow from its start, its controls and the clock: one LU of the defects'
Jacobian. What is left, a quadratic in start, controls and clock, is minimised over the controls from
the last segment to the first (a Riccati sweep), carrying the global unknowns, the final state and
its multiplier as parameters. A small dense system of the global unknowns ends it.

The inertia of the whole is right, so that the step descends, if every Cholesky factorisation exists
and the last system has as many negative eigenvalues as multipliers (Haynsworth).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, lu_factor, lu_solve
from jaxtyping import Array, Bool, Float

from jaxguide.nominal.transcription import Dual, Ends, Nodes, Primal, Residual, Transcription

_COMPLIANCE = 1e-8  # of path constraints: an equality is a spring of stiffness 1/this, then exact


class System(NamedTuple):
    """What a Newton step is made of."""

    nodes: Nodes
    ends: Ends
    node_hessian: Float[Array, "segment node in in"]
    end_hessian: Float[Array, "in in"]
    residual: Residual
    sigma: Primal  # of the barrier: z/(w - l) + z/(u - w); inf for a slack that is given
    pull: Primal  # gradient of the barrier
    dual: Dual
    given: Primal  # bool: entries that must not move


class Step(NamedTuple):
    """Change of the unknowns, and the multipliers themselves after it."""

    primal: Primal
    dual: Dual


class _Segments(NamedTuple):
    """States after each segment's start, linear in v = (start, controls, clock, 1)."""

    lu: Any
    states: Float[Array, "segment after n v"]
    extra: Float[Array, "segment row v"]
    extra_states: Float[Array, "segment row after_n"]


def eliminate(program: Transcription, system: System) -> _Segments:
    """States from the defects' linearisation, and what the extra rows then ask of the controls."""
    rule, size = program.rule, program.sizes
    n, C, dtype = size.n, size.nodes, system.sigma.x.dtype
    A, B = jnp.asarray(rule.A, dtype), jnp.asarray(rule.B, dtype)
    eye = jnp.eye(n, dtype=dtype)
    rows, support = A.shape
    diagonal = jnp.einsum("rp,ab->rapb", A, eye)
    own = slice(rule.first, rule.first + C)

    def one(item: tuple) -> _Segments:
        F, c = item[0][:, :n], item[1]
        G = diagonal.at[:, :, own].add(-jnp.einsum("rk,kab->rakb", B, F[:, :, :n]))
        to_u = -jnp.einsum("rk,kaj->rakj", B, F[:, :, n : n + size.m]).reshape(rows, n, -1)
        to_clock = -jnp.einsum("rk,kaj->raj", B, F[:, :, n + size.m :])
        right = jnp.concatenate([G[:, :, 0], to_u, to_clock, c[:, :, None]], axis=2)
        G = G[:, :, 1:].reshape(rows, n, (support - 1) * n)
        flat = lambda a: a.reshape(-1, a.shape[2])
        lu = lu_factor(flat(G[rule.main]))
        states = -lu_solve(lu, flat(right[rule.main]))
        extra_states = flat(G[rule.extra])
        extra = flat(right[rule.extra]) + extra_states @ states
        return _Segments(lu, states.reshape(support - 1, n, -1), extra, extra_states)

    return over_segments(one, (system.nodes.jacobian, system.residual.defect))


def over_segments(f: Any, items: Any) -> Any:
    """`f` of every segment in turn: LAPACK under `vmap` may hang, and gains nothing on CPU."""
    if jax.tree_util.tree_leaves(items)[0].shape[0] == 1:
        out = f(jax.tree_util.tree_map(lambda a: a[0], items))
        return jax.tree_util.tree_map(lambda a: a[None], out)
    return jax.lax.map(f, items)


class _Reduced(NamedTuple):
    """The quadratic of each segment in v, and its force on states."""

    H: Float[Array, "segment v v"]
    force: Float[Array, "segment node in_1 v"]


def _spring(system: System) -> tuple[Array, Array]:
    """Stiffness of the path rows once their slacks are eliminated, and the force of the slacks."""
    sigma, fixed = system.sigma.path, system.given.path
    flexible = jnp.where(fixed, 0.0, 1 / jnp.where(sigma > 0, sigma, 1.0))
    stiffness = jnp.where((sigma > 0) | fixed, 1 / (flexible + _COMPLIANCE), 0.0)
    force = jnp.where(fixed, 0.0, system.pull.path / (1 + _COMPLIANCE * sigma))
    return stiffness, force


def _reduce(program: Transcription, system: System, segments: _Segments, delta: Array) -> _Reduced:
    size, rule = program.sizes, program.rule
    n, m, C, S = size.n, size.m, size.nodes, size.segments
    dtype = delta.dtype
    J, W = system.nodes.jacobian, system.node_hessian
    stiffness, force = _spring(system)
    h_q = J[:, :, n + 1 :]
    W = W + jnp.einsum("skha,skh,skhb->skab", h_q, stiffness, h_q)
    pushed = stiffness * (system.residual.path + _COMPLIANCE * system.dual.path) + force
    g = J[:, :, n] + jnp.einsum("skha,skh->ska", h_q, pushed)
    # Barrier and regularisation of the controls; those of the states are added to all of them.
    diagonal = jnp.zeros((S, C, W.shape[2]), dtype)
    diagonal = diagonal.at[:, :, n : n + m].set(system.sigma.u + delta)
    W = W + diagonal[:, :, :, None] * jnp.eye(W.shape[2], dtype=dtype)
    g = g.at[:, :, n : n + m].add(system.pull.u)
    bordered = jnp.concatenate(
        [
            jnp.concatenate([W, g[:, :, :, None]], axis=3),
            jnp.concatenate([g, jnp.zeros((S, C, 1), dtype)], axis=2)[:, :, None],
        ],
        axis=2,
    )
    T = _inputs_of(program, segments)
    force_ = jnp.einsum("skab,skbv->skav", bordered, T)
    flat = lambda a: a.reshape(S, -1, a.shape[3])
    H = jnp.einsum("siv,siw->svw", flat(T), flat(force_))
    X = segments.states
    sprung = (system.sigma.x + delta)[..., None] * X
    sprung = sprung.at[..., -1].add(system.pull.x)
    H = H + jnp.einsum("siv,siw->svw", flat(X), flat(sprung))
    H = H.at[:, -1].add(jnp.einsum("skn,sknv->sv", system.pull.x, X))
    return _Reduced(H, force_)


def _inputs_of(program: Transcription, segments: _Segments) -> Float[Array, "segment node in v"]:
    """(x, u, clock, 1) of every node from v."""
    size, rule = program.sizes, program.rule
    X = segments.states
    S, _, n, nv = X.shape
    C, m = size.nodes, size.m
    start = jnp.broadcast_to(jnp.eye(n, nv, dtype=X.dtype), (S, 1, n, nv))
    x = jnp.concatenate([start, X], axis=1)[:, rule.first : rule.first + C]
    u = jnp.eye(C * m, nv, n, dtype=X.dtype).reshape(C, m, nv)
    rest = nv - n - C * m
    clock = jnp.broadcast_to(jnp.eye(rest, nv, n + C * m, dtype=X.dtype), (C, rest, nv))
    same = jnp.broadcast_to(jnp.concatenate([u, clock], axis=1), (S, C, m + rest, nv))
    return jnp.concatenate([x, same], axis=2)


class _Policy(NamedTuple):
    """Controls, and multipliers of the extra rows, linear in theta; and the value after it."""

    controls: Float[Array, "segment um theta"]
    extra: Float[Array, "segment row theta"]
    after: Float[Array, "segment theta theta"]


def _sweep(
    program: Transcription, segments: _Segments, H: Array, rho: Array
) -> tuple[_Policy, Array, Bool[Array, ""]]:
    """Minimises over the controls, last segment first. theta = (state, times, p, xf, lambda_f, 1)."""
    size = program.sizes
    n, m, C = size.n, size.m, size.nodes
    nu, np_, dtype = C * m, size.parameters, H.dtype
    n_theta = n + 2 + np_ + 2 * n + 1
    own, xf, lam = slice(0, n), slice(n + 2 + np_, 2 * n + 2 + np_), slice(-n - 1, -1)
    eye = jnp.eye(n, dtype=dtype)
    # V at the end: lambda_f^T (x - xf) + rho |x - xf|^2 / 2.
    P = jnp.zeros((n_theta, n_theta), dtype)
    P = P.at[own, own].set(rho * eye).at[xf, xf].set(rho * eye)
    P = P.at[own, xf].set(-rho * eye).at[xf, own].set(-rho * eye)
    P = P.at[own, lam].set(eye).at[lam, own].set(eye)
    P = P.at[xf, lam].set(-eye).at[lam, xf].set(-eye)
    # (start, clock, 1) of a segment from theta.
    rest = jnp.concatenate([jnp.arange(n), jnp.arange(n + nu, n + nu + 2 + np_ + 1)])
    L = jnp.zeros((size.segments, n + 2 + np_ + 1, n_theta), dtype)
    L = L.at[:, :n, :n].set(eye)
    L = L.at[:, n : n + 2, n : n + 2].set(program.clocks)
    L = L.at[:, n + 2 : n + 2 + np_, n + 2 : n + 2 + np_].set(jnp.eye(np_, dtype=dtype))
    L = L.at[:, -1, -1].set(1.0)
    controls = slice(n, n + nu)

    def back(carry: tuple, item: tuple) -> tuple[tuple, _Policy]:
        P, ok = carry
        X, H, E, L = item
        X_u, X_t = X[:, controls], X[:, rest] @ L
        E_u, E_t = E[:, controls], E[:, rest] @ L
        PX = P[:n, :n] @ X_t + P[:n].at[:, :n].set(0.0)
        R = H[controls, controls] + X_u.T @ P[:n, :n] @ X_u + rho * (E_u.T @ E_u)
        N = H[controls][:, rest] @ L + X_u.T @ PX + rho * (E_u.T @ E_t)
        # Theta after the segment is (X, the rest of theta).
        ahead = jnp.eye(n_theta, dtype=dtype).at[:n].set(X_t)
        Q = L.T @ H[rest][:, rest] @ L + ahead.T @ P @ ahead + rho * (E_t.T @ E_t)
        factor = jnp.linalg.cholesky(R)
        ok = ok & jnp.all(jnp.isfinite(factor))
        solved = cho_solve((factor, True), jnp.concatenate([N, E_u.T], axis=1))
        KN, KE = solved[:, :n_theta], solved[:, n_theta:]
        Q = Q - N.T @ KN
        eta = jnp.zeros((0, n_theta), dtype)
        policy = KN
        if E.shape[0]:
            D = E_t - E_u @ KN
            # How far the extra rows can be met at all; the floor only guards their rank.
            gram = E_u @ KE
            floor = 1e-14 * jnp.trace(gram) * jnp.eye(E.shape[0], dtype=dtype)
            small = jnp.linalg.cholesky(gram + floor)
            ok = ok & jnp.all(jnp.isfinite(small))
            eta = cho_solve((small, True), D)
            policy = KN + KE @ eta
            Q = Q + D.T @ eta
        return ((Q + Q.T) / 2, ok), _Policy(-policy, eta, P)

    items = (segments.states[:, -1], H, segments.extra, L)
    (P, ok), policies = jax.lax.scan(back, (P, jnp.array(True)), items, reverse=True)
    return policies, P, ok


def _globals(
    program: Transcription, system: System, P: Array, delta: Array
) -> tuple[Array, Array, Bool[Array, ""]]:
    """theta at the start, and nu: the small dense system that ends the elimination."""
    size = program.sizes
    n, q, dtype = size.n, size.end, P.dtype
    nb = n + 2 + size.parameters + n  # x0, times, p, xf
    sigma, pull = system.sigma, system.pull
    moving = n + 2 + size.parameters
    join = lambda w: jnp.concatenate([w.x0, w.times, w.p])
    given = join(system.given)
    e_b = system.ends.jacobian[1:]
    K = jnp.zeros((nb + n + q, nb + n + q), dtype)
    K = K.at[: nb + n, : nb + n].add(P[:-1, :-1])
    K = K.at[:nb, :nb].add(system.end_hessian)
    own = jnp.where(given, 0.0, join(sigma)) + delta  # of xf, a state, the segment has it
    K = K.at[:moving, :moving].add(jnp.diag(own))
    fixed, stiff = system.given.end, system.sigma.end
    flexible = jnp.where(fixed, 0.0, 1 / jnp.maximum(stiff, 1e-12))
    K = K.at[nb + n :, :nb].set(e_b).at[:nb, nb + n :].set(e_b.T)
    K = K.at[nb + n :, nb + n :].set(-jnp.diag(flexible))
    rhs = jnp.zeros(nb + n + q, dtype).at[: nb + n].add(-P[:-1, -1])
    rhs = rhs.at[:nb].add(-system.ends.jacobian[0])
    rhs = rhs.at[:moving].add(-join(pull))
    pulled = jnp.where(fixed, 0.0, flexible * system.pull.end)
    rhs = rhs.at[nb + n :].set(-system.residual.end - pulled)
    held = jnp.concatenate([given, jnp.zeros(nb + n + q - moving, bool)])
    K = jnp.where(held[:, None] | held[None, :], jnp.eye(len(held), dtype=dtype), K)
    rhs = jnp.where(held, 0.0, rhs)
    size_ = jnp.sqrt(jnp.max(jnp.abs(K), axis=1) + 1e-300)
    scaled = K / size_[:, None] / size_[None, :]
    finite = jnp.all(jnp.isfinite(scaled))
    scaled = jnp.where(finite, scaled, jnp.eye(len(rhs), dtype=dtype))
    eigenvalues, vectors = jnp.linalg.eigh(scaled)
    ok = finite & (jnp.sum(eigenvalues < 0) == n + q)
    invert = lambda r: vectors @ ((vectors.T @ r) / eigenvalues)
    target = rhs / size_
    solution = invert(target)
    solution = solution + invert(target - scaled @ solution)
    solution = solution / size_
    return jnp.append(solution[: nb + n], 1.0), solution[nb + n :], ok


def solve(
    program: Transcription, system: System, segments: _Segments, delta: Array, rho: Array
) -> tuple[Step, Bool[Array, ""]]:
    """The Newton step with `delta` I added to the Hessian; and whether the inertia was right."""
    size, rule = program.sizes, program.rule
    n, m, S, C = size.n, size.m, size.segments, size.nodes
    reduced = _reduce(program, system, segments, delta)
    policies, P, convex = _sweep(program, segments, reduced.H, rho)
    theta, nu, regular = _globals(program, system, P, delta)

    parameters = theta[n + 2 : n + 2 + size.parameters]

    def forward(theta: Array, item: tuple) -> tuple[Array, tuple]:
        policy, states, c = item
        u = policy.controls @ theta
        one = jnp.ones(1, theta.dtype)
        v = jnp.concatenate([theta[:n], u, c @ theta[n : n + 2], parameters, one])
        after = theta.at[:n].set(states[-1] @ v)
        return after, (v, policy.extra @ theta, policy.after[:n] @ after)

    items = (policies, segments.states, program.clocks)
    _, (v, eta, costate) = jax.lax.scan(forward, theta, items)
    dx = jnp.einsum("sknv,sv->skn", segments.states, v)
    du = v[:, n : n + C * m].reshape(S, C, m)
    # Multipliers of the main rows: the force on each state after the start must vanish.
    force = jnp.einsum("skav,sv->ska", reduced.force, v)[:, :, :n]
    last = rule.first + C
    on_states = jnp.zeros((S, size.after + 1, n), delta.dtype).at[:, rule.first : last].set(force)
    on_states = on_states[:, 1:] + (system.sigma.x + delta) * dx + system.pull.x
    on_states = on_states.at[:, -1].add(costate).reshape(S, -1)
    on_states = on_states + jnp.einsum("sri,sr->si", segments.extra_states, eta)
    main = over_segments(lambda a: lu_solve(a[0], -a[1], trans=1), (segments.lu, on_states))
    rows = jnp.zeros((S, rule.A.shape[0], n), delta.dtype)
    rows = rows.at[:, rule.main].set(main.reshape(S, -1, n))
    rows = rows.at[:, rule.extra].set(eta.reshape(S, -1, n))
    # Path and endpoint slacks, from their rows.
    stiffness, force = _spring(system)
    T = _inputs_of(program, segments)[:, :, :-1]
    dq = jnp.einsum("skav,sv->ska", T, v)
    h_dq = jnp.einsum("skha,ska->skh", system.nodes.jacobian[:, :, n + 1 :], dq)
    was = system.dual.path
    path = stiffness * (h_dq + system.residual.path + _COMPLIANCE * was) + force
    d_path = h_dq + system.residual.path - _COMPLIANCE * (path - was)
    b = theta[: 2 * n + 2 + size.parameters]
    d_end = system.ends.jacobian[1:] @ b + system.residual.end
    primal = Primal(
        theta[:n],
        dx,
        du,
        theta[n : n + 2],
        parameters,
        jnp.where(system.given.path, 0.0, d_path),
        jnp.where(system.given.end, 0.0, d_end),
    )
    return Step(primal, Dual(rows, path, nu)), convex & regular
