"""The Newton matrix of a transcription factorised, segment by segment.

Once each segment's states are eliminated, a quadratic in (start, z, clock, parameters) is left. It
is minimised over the free directions z from the last segment to the first (a Riccati sweep), with
the global unknowns, the final state and its multiplier carried as parameters. A small dense system
of the globals ends it.

The inertia of the whole matrix is right, so that the step descends, if every Cholesky factorisation
exists and the last system has as many negative eigenvalues as multipliers (Haynsworth's inertia
additivity).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, added, cho_solve, cholesky, eigh, either, put, scan, xp
from jaxguide.nominal.direct.elimination import Segments, gram, on_diagonal
from jaxguide.nominal.direct.newton_system import NewtonSystem
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Counts

# Curvature of the penalty on the final state's gap in the sweep, relative to the Hessian's largest
# entry. Chosen, not tuned: it need only make the sweep convex; the multiplier beside it closes the
# gap.
PENALTY = 1e2
# Softness lent to the multipliers of the last system, relative to its largest entries, so that a
# redundant constraint does not make it singular. Chosen, not tuned: some 1e5 roundings, which
# refinement takes out again.
_SOFT = 1e-11
_LEAST_SIZE = 1e-300  # of a row of the last system, lest a row of zeros be divided by zero
# Least barrier curvature of an endpoint slack, so that its inverse, the flexibility, is finite.
# Chosen, not tuned: far below any that the barrier gives.
_LEAST_CURVATURE = 1e-12


class SweepLayout(NamedTuple):
    """Slices of the sweep's parameters theta = (start, times, p, xf, lambda_f), lambda_f being the
    multiplier of the final state; `moving`: how many of the first move freely, (x0, times, p).
    """

    start: slice
    times: slice
    p: slice
    xf: slice
    lambda_f: slice
    moving: int
    theta: int  # how many there are


class SweepStage(NamedTuple):
    """A segment of the backward sweep; theta: see `SweepLayout`.

    - `factor`: Cholesky of the Hessian by z. `N`: mixed Hessian by z and theta. `KN`: its feedback,
      z = -(KN theta + k).
    - `X_u`, `X_t`: the segment's last state from z and theta.
    - `L`: (start, clock, parameters) of the segment from theta.
    - `P`: Hessian of the value after the segment.
    """

    factor: Array
    N: Array
    KN: Array
    X_u: Array
    X_t: Array
    L: Array
    P: Array


class Factor(NamedTuple):
    """The factorised matrix: everything that a right-hand side needs.

    - `W`: see Segments, regularised. `delta`: added to the Hessian's diagonal.
    - `rho`: curvature of the penalty on the final state's gap in the sweep.
    - `eigenvalues`, `vectors`, `equilibrium`, `K`: the system of the globals, scaled by
      `equilibrium`. `held`: which of them may not move.
    """

    W: Float[Array, "segment node in in"]
    delta: Float[Array, ""]
    rho: Float[Array, ""]
    stages: SweepStage
    eigenvalues: Float[Array, " k"]
    vectors: Float[Array, "k k"]
    equilibrium: Float[Array, " k"]
    K: Float[Array, "k k"]
    held: Bool[Array, " k"]


def sweep_layout(counts: Counts) -> SweepLayout:
    """Places of the sweep's parameters."""
    n, times, p = counts.n, counts.times, counts.parameters
    moving = n + times + p
    theta = moving + 2 * n
    return SweepLayout(
        slice(0, n),
        slice(n, n + times),
        slice(n + times, moving),
        slice(moving, moving + n),
        slice(theta - n, theta),
        moving,
        theta,
    )


def factorise(
    program: Transcription, system: NewtonSystem, segments: Segments, delta: Array, rho: Array
) -> tuple[Factor, Bool[Array, ""]]:
    """The matrix with `delta` I added to its Hessian, factorised; and whether its inertia is
    right. `rho`: see Factor."""
    counts = program.counts
    n, W = counts.n, segments.W
    everywhere = xp.broadcast_to(delta, (*W.shape[:2], counts.m))
    W = W + on_diagonal(everywhere, n, W.shape[2])
    regular = lambda: (
        segments.H + delta * (gram(segments.X, segments.X) + gram(segments.U, segments.U))
    )
    H = either(delta > 0, regular, lambda: segments.H)
    stages, P, convex = _sweep(program, segments, H, rho)
    K, held = _globals(program, system, P, delta)
    equilibrium = xp.sqrt(xp.max(xp.abs(K), axis=1) + _LEAST_SIZE)
    scaled = K / equilibrium[:, None] / equilibrium[None, :]
    finite = xp.all(xp.isfinite(scaled))
    # Where the end is hardly within reach, or a constraint is redundant, its multiplier is soft;
    # refinement takes the softness out again.
    soft = xp.arange(len(held)) >= len(held) - n - counts.end
    scaled = scaled - xp.diag(xp.where(soft, _SOFT, 0.0))
    eye = xp.eye(len(held), dtype=delta.dtype)
    eigenvalues, vectors = eigh(xp.where(finite, scaled, eye))
    ok = convex & finite & (xp.sum(eigenvalues < 0) == n + counts.end)
    return Factor(W, delta, rho, stages, eigenvalues, vectors, equilibrium, scaled, held), ok


def _sweep(
    program: Transcription, segments: Segments, H: Array, rho: Array
) -> tuple[SweepStage, Array, Bool[Array, ""]]:
    """Minimises over the free directions, last segment first: the stages, the Hessian of the value
    before the first segment, and whether every minimum exists."""
    counts, dtype = program.counts, H.dtype
    n, at = counts.n, sweep_layout(counts)
    nu = H.shape[1] - n - 2 - counts.parameters
    controls = slice(n, n + nu)
    rest = np.concatenate([np.arange(n), np.arange(n + nu, H.shape[1])])  # of v: all but z
    eye = np.eye(at.theta, dtype=dtype)

    def back(carry: tuple, item: tuple) -> tuple[tuple, SweepStage]:
        P, ok = carry
        X, H, L = item
        X_u, X_t = X[:, controls], X[:, rest] @ L
        ahead = put(eye, np.s_[:n], X_t)  # theta after the segment
        R = H[controls, controls] + X_u.T @ P[:n, :n] @ X_u
        N = H[controls][:, rest] @ L + X_u.T @ (P[:n] @ ahead)
        Q = L.T @ H[rest][:, rest] @ L + ahead.T @ P @ ahead
        factor = cholesky(R)
        ok = ok & xp.all(xp.isfinite(factor))
        KN = cho_solve(factor, N)
        Q = Q - N.T @ KN
        return ((Q + Q.T) / 2, ok), SweepStage(factor, N, KN, X_u, X_t, L, P)

    start = (_final_value(at, rho, n, dtype), xp.array(True))
    items = (segments.X[:, -1], H, _to_segments(program, at, dtype))
    (P, ok), stages = scan(back, start, items, reverse=True)
    return stages, P, ok


def _final_value(at: SweepLayout, rho: Array, n: int, dtype: Any) -> Array:
    """Hessian of the value at the end, lambda_f^T (x - xf) + rho |x - xf|^2 / 2."""
    own, xf, lam = at.start, at.xf, at.lambda_f
    eye = xp.eye(n, dtype=dtype)
    P = xp.zeros((at.theta, at.theta), dtype)
    for a, b, value in ((own, own, rho * eye), (xf, xf, rho * eye), (own, xf, -rho * eye)):
        P = put(put(P, np.s_[a, b], value), np.s_[b, a], value)
    for a, value in ((own, eye), (xf, -eye)):
        P = put(put(P, np.s_[a, lam], value), np.s_[lam, a], value)
    return P


def _to_segments(program: Transcription, at: SweepLayout, dtype: Any) -> Array:
    """(start, clock, parameters) of every segment from theta."""
    counts = program.counts
    n, np_ = counts.n, counts.parameters
    L = xp.zeros((counts.segments, n + 2 + np_, at.theta), dtype)
    L = put(L, np.s_[:, :n, at.start], xp.eye(n, dtype=dtype))
    L = put(L, np.s_[:, n : n + 2, at.times], program.clocks)
    return put(L, np.s_[:, n + 2 :, at.p], xp.eye(np_, dtype=dtype))


def _globals(
    program: Transcription, system: NewtonSystem, P: Array, delta: Array
) -> tuple[Array, Bool[Array, " k"]]:
    """The matrix of (x0, times, p, xf, lambda_f, nu), and which of them are held. nu: multipliers
    of the endpoint constraints."""
    counts = program.counts
    n, q, dtype = counts.n, counts.end, P.dtype
    moving = sweep_layout(counts).moving
    nb = moving + n  # and xf
    join = lambda w: xp.concatenate([w.x0, w.times, w.p])
    given = join(system.given)
    e_b = system.ends.jacobian[1:]
    K = put(xp.zeros((nb + n + q, nb + n + q), dtype), np.s_[: nb + n, : nb + n], P)
    K = added(K, np.s_[:nb, :nb], system.end_hessian)
    own = xp.where(given, 0.0, join(system.sigma)) + delta  # of xf, a state, the segment has it
    K = added(K, np.s_[:moving, :moving], xp.diag(own))
    K = put(put(K, np.s_[nb + n :, :nb], e_b), np.s_[:nb, nb + n :], e_b.T)
    K = put(K, np.s_[nb + n :, nb + n :], -xp.diag(flexibility(system)))
    held = xp.concatenate([given, xp.zeros(nb + n + q - moving, bool)])
    return xp.where(held[:, None] | held[None, :], xp.eye(len(held), dtype=dtype), K), held


def flexibility(system: NewtonSystem) -> Float[Array, " q"]:
    """1/Sigma of the endpoint slacks; 0 where they are given."""
    return xp.where(system.given.end, 0.0, 1 / xp.maximum(system.sigma.end, _LEAST_CURVATURE))
