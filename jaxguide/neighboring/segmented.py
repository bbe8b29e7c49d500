r"""Gains by one backward sweep over short segments.

The adjoint rows $G(t) = [G_x\ G_\lambda]$ of the end conditions, $\dot G = -G M$,
$G(t_f) = [\psi_x\ \psi_\lambda]$, annihilate every neighbouring extremal: $G y = 0$ at all times,
so $\delta\lambda = S\,\delta x$ with $S = -G_\lambda^{-1} G_x$. Unlike a Riccati sweep nothing is
infinite at a hard end. On each segment the transition matrix is collocated at Gauss points in
integral form (which superconverges) by Picard sweeps, all segments at once, then joined.

Arrays run (node, row, column, segment): the batch is last, so that small products vectorise.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.linalg import cholesky_positive, gauss_solve
from jaxguide.neighboring.linearization import Canonical, Terminal, canonical, second_variation
from jaxguide.problem import Problem, is_free
from jaxguide.spectral import interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal, Point

SEGMENTS, NODES, SWEEPS = 72, 8, 8  # the defaults: some 1e-9 where a control turns sharply
_GROUP = 8  # segments joined without renormalising; growth over so few is harmless
_PROBES = 256
# Segments shrink towards the end in proportion to the time left, down to this part of the horizon:
# hard constraints make the gain a ratio of small differences there.
_LAST = 2.0**-17
_GRADING = 0.8  # segments per e-fold of the time left; chosen by experiment


class Sweep(NamedTuple):
    """One solution of the adjoint rows: everything needed to evaluate them at any time."""

    nodes: Float[Array, " s"]
    breaks: Float[Array, " edge"]
    slopes: Float[Array, "segment s two_n w"]  # (Psi(t_j) - I) / (t_e - t_j), Psi = Phi(t_e, t)
    ends: Float[Array, "segment row w"]  # G at each segment's end
    scale: Float[Array, " two_n"]  # y = scale * scaled y

    def locate(self, t: Array) -> Array:
        last = self.breaks.shape[0] - 2
        after = jnp.searchsorted(self.breaks, t, side="right", method="compare_all")
        return jnp.clip(after - 1, 0, last)

    def transition(self, i: Array, t: Array) -> Float[Array, "two_n w"]:
        """Phi(t_e, t) with the columns of parameters, scaled, inside segment `i`."""
        a, b = self.breaks[i], self.breaks[i + 1]
        tau = (2 * t - a - b) / jnp.where(b > a, b - a, 1.0)
        row = interpolation_matrix(self.nodes, tau[None])[0]
        slope = jnp.tensordot(row, self.slopes[i], 1)
        return _identity(slope.shape, slope.dtype) + (b - t) * slope

    def rows(self, t: Array) -> Float[Array, "row w"]:
        """G(t), scaled."""
        i = self.locate(t)
        two_n = self.scale.shape[0]
        end = self.ends[i]
        moved = self.transition(i, t)
        w = moved.shape[1]  # the target's columns beyond are constant
        change = end[:, :two_n] @ (moved - _identity((two_n, w), end.dtype))
        return end.at[:, :w].add(change)


def _identity(shape: tuple[int, ...], dtype: Any) -> Array:
    return jnp.eye(shape[0], shape[1], dtype=dtype)


@functools.partial(jax.jit, static_argnames="parameters")
def canonical_at(
    problem: Problem, t: Array, point: Point, parameters: tuple[str, ...]
) -> tuple[Canonical, Array]:
    """M, b, U at one point of the extremal, and whether H_uu is positive definite there."""
    v = second_variation(problem, t, point.x, point.u, point.costate, parameters)
    return canonical(v), cholesky_positive(v.H_uu)


def scaling(extremal: Extremal, M: Float[Array, "probe two_n two_n"]) -> Float[Array, " two_n"]:
    """Units in which M is balanced: states by their size, costates so that B and Q match."""
    n = extremal.problem.n
    size = jnp.max(jnp.abs(extremal.x), axis=0)
    size = jnp.where(size > 0, size, 1.0)
    B = jnp.max(jnp.abs(M[:, :n, n:] / (size[:, None] * size[None, :])[None]))
    Q = jnp.max(jnp.abs(M[:, n:, :n] * (size[:, None] * size[None, :])[None]))
    ratio = jnp.where((B > 0) & (Q > 0), Q / jnp.where(B > 0, B, 1.0), 1 / jnp.where(B > 0, B, 1.0))
    ratio = jnp.where(jnp.isfinite(ratio) & (ratio > 0), ratio, 1.0)
    beta = jnp.where((B > 0) & (Q > 0), jnp.sqrt(ratio), ratio)
    return jax.lax.stop_gradient(jnp.concatenate([size, beta / size]))


def place_breaks(
    t: Float[Array, " probe"], M: Float[Array, "probe two_n two_n"], segments: int
) -> Float[Array, " edge"]:
    r"""Breaks that equidistribute $|M'|/|M| + \sqrt{|M''|/|M|} + |M|$, with a floor.

    The first two are the inverse length over which M changes; |M| bounds the Picard contraction.
    """
    h = jnp.diff(t)
    norm = jnp.sqrt(jnp.sum(M**2, axis=(1, 2)))
    slope = jnp.diff(M, axis=0) / h[:, None, None]
    bend = jnp.diff(slope, axis=0) / ((h[1:] + h[:-1]) / 2)[:, None, None]
    size = lambda a: jnp.sqrt(jnp.sum(a**2, axis=(1, 2)))
    middle = (norm[1:] + norm[:-1]) / 2 + jnp.finfo(t.dtype).tiny
    bend = size(bend)
    bend = jnp.maximum(jnp.append(bend, bend[-1:]), jnp.concatenate([bend[:1], bend]))
    density = size(slope) / middle + jnp.sqrt(bend / middle) + 0.5 * middle
    density = jnp.where(jnp.isfinite(density), density, 0.0)
    span = t[-1] - t[0]
    floor = 2.0 / span + 0.1 * jnp.sum(density * h) / span
    mass = jnp.concatenate([jnp.zeros(1, t.dtype), jnp.cumsum((density + floor) * h)])
    left = (t[-1] - t) / span + _LAST
    e_folds = jnp.log(left[0] / left)
    # The regular part shares what the grading leaves of the segments.
    grading = jnp.minimum(_GRADING, 0.5 * segments / e_folds[-1])
    mass = mass / mass[-1] * (segments - grading * e_folds[-1]) + grading * e_folds
    wanted = mass[-1] * jnp.linspace(0.0, 1.0, segments + 1, dtype=t.dtype)
    breaks = jnp.interp(wanted, mass, t).at[0].set(t[0]).at[-1].set(t[-1])
    return jax.lax.stop_gradient(breaks)


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
) -> tuple[Array, Array]:
    """Phi(t_e, t) with parameter columns, at the Gauss nodes and at the segment's start."""
    s, two_n, w, _ = M.shape
    _, weights, W = _gauss_integration(s)
    W, weights = jnp.asarray(W, M.dtype), jnp.asarray(weights, M.dtype)
    half = (widths / 2)[None, None, None, :]
    eye = _identity((two_n, w), M.dtype)[None, :, :, None]

    def times_m(psi: Array) -> Array:
        products = [psi[:, :, k, None] * M[:, None, k] for k in range(two_n)]
        return sum(products[1:], products[0])

    # The first sweep from Psi = I needs no product: F = M.
    psi = eye + half * jnp.tensordot(W, M, 1) if start is None else start

    def sweep(_: Any, psi: Array) -> Array:
        return eye + half * jnp.tensordot(W, times_m(psi), 1)

    psi = jax.lax.fori_loop(0, sweeps - (start is None), sweep, psi)
    return psi, eye[0] + half[0] * jnp.tensordot(weights, times_m(psi), 1)


def _orthonormal_rows(G: Array, n: int, two_n: int) -> Array:
    """Row operations that keep G's row space: Gram-Schmidt, earlier (hard) rows first."""
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
    """G at the segments' ends, from the end conditions backwards."""
    two_n, w, segments = transitions.shape
    extra = jnp.concatenate(
        [jnp.zeros((w - two_n, two_n), terminal.dtype), jnp.eye(w - two_n, dtype=terminal.dtype)],
        axis=1,
    )
    extra = jnp.broadcast_to(extra[:, :, None], (w - two_n, w, segments))
    full = jnp.concatenate([transitions, extra]).transpose(2, 0, 1)
    groups = full.reshape(segments // _GROUP, _GROUP, w, w)

    def back(after: Array, here: Array) -> tuple[Array, Array]:
        now = after @ here
        return now, after

    eye = jnp.broadcast_to(jnp.eye(w, dtype=terminal.dtype), (groups.shape[0], w, w))
    whole, suffix = jax.lax.scan(back, eye, groups.transpose(1, 0, 2, 3), reverse=True)

    def step(G: Array, group: Array) -> tuple[Array, Array]:
        G = _orthonormal_rows(G, n, two_n)
        return G @ group, G

    _, at_group_end = jax.lax.scan(step, terminal, whole, reverse=True)
    ends = at_group_end[:, None] @ suffix.transpose(1, 0, 2, 3)
    return ends.reshape(segments, terminal.shape[0], w)


class Pair(NamedTuple):
    """A sweep, a finer one beside it, and the canonical system at the requested times."""

    sweep: Sweep
    finer: Sweep
    at_times: Canonical
    control: Float[Array, "time m"]  # of the extremal, at the requested times
    convex: Array  # by segment: H_uu positive definite at its nodes


def solve_sweeps(
    extremal: Extremal,
    terminal: Terminal,
    times: Float[Array, " time"],
    segments: int,
    nodes: int,
    sweeps: int,
    parameters: tuple[str, ...],
) -> Pair:
    """The adjoint rows on `nodes` and on `nodes + 2` Gauss points a segment.

    The second shows the error of the first. Both are stored on the finer points (a polynomial of
    lower degree is exact there), so that everything after works on the pair at once.
    """
    problem = extremal.problem
    n, p = problem.n, len(parameters)
    two_n, q = 2 * n, terminal.psi_target.shape[1]
    t_probe = _probe_times(extremal)
    M_probe = jax.vmap(lambda t: canonical_at(problem, t, extremal.point(t), ())[0].M)(t_probe)
    scale = scaling(extremal, M_probe)
    ratio = scale[None, :] / scale[:, None]
    breaks = place_breaks(t_probe, M_probe * ratio[None], segments)
    widths = jnp.diff(breaks)

    counts = (nodes, nodes + 2)
    taus = [jnp.asarray(nodes_lg(s)[0], breaks.dtype) for s in counts]
    middle = (breaks[1:] + breaks[:-1]) / 2
    where = [middle[None, :] + (widths / 2)[None, :] * tau[:, None] for tau in taus]
    everywhere = jnp.concatenate([where[0].reshape(-1), where[1].reshape(-1), times])
    points = extremal(everywhere)
    at_points = jax.vmap(lambda t, point: canonical_at(problem, t, point, parameters))
    c, convex = at_points(everywhere, points)
    M = jnp.concatenate([c.M * ratio[None], c.b / scale[None, :, None]], axis=2)
    first, second = counts[0] * segments, sum(counts) * segments
    by_node = lambda a, s: a.reshape(s, segments, two_n, -1).transpose(0, 2, 3, 1)
    M1, M2 = by_node(M[:first], counts[0]), by_node(M[first:second], counts[1])

    eye = _identity((two_n, M1.shape[2]), M.dtype)[None, :, :, None]
    gaps = [(breaks[1:][None, :] - t)[:, None, None, :] for t in where]
    slope = lambda psi, gap: (psi - eye) / jnp.where(gap > 0, gap, 1.0)
    psi1, begin1 = collocate(M1, widths, None, sweeps)
    to_finer = interpolation_matrix(taus[0], taus[1])
    slopes1 = jnp.tensordot(to_finer, slope(psi1, gaps[0]), 1)
    # The finer one starts from the coarser, so few sweeps show the difference.
    psi2, begin2 = collocate(M2, widths, eye + gaps[1] * slopes1, 5)
    slopes2 = slope(psi2, gaps[1])

    constant = jnp.concatenate([scale, jnp.ones(p + q, scale.dtype)])
    rows = jnp.concatenate([terminal.psi, terminal.psi_p, terminal.psi_target], axis=1)
    if is_free(problem.final_time):
        rows = jnp.concatenate([rows, terminal.time[None]])
    rows = rows * constant[None, :]
    begins = jnp.pad(jnp.stack([begin1, begin2]), ((0, 0), (0, 0), (0, q), (0, 0)))
    ends = jax.vmap(lambda begin: join(rows, begin, n))(begins)
    pair = [
        Sweep(taus[1], breaks, slopes.transpose(3, 0, 1, 2), ends[i], scale)
        for i, slopes in enumerate((slopes1, slopes2))
    ]
    at_times = jax.tree_util.tree_map(lambda a: a[second:], c)
    convex = jnp.all(convex[:first].reshape(counts[0], segments), axis=0)
    return Pair(pair[0], pair[1], at_times, points.u[second:], convex)


def _probe_times(extremal: Extremal) -> Array:
    """Times to look for rapid change: evenly within each of the extremal's own segments, and
    geometrically towards the end of the last."""
    breaks = extremal.breaks
    per = max(8, -(-_PROBES // (breaks.shape[0] - 1)))
    even = np.arange(per) / per
    # Sorted here, not in the program: XLA's sort would take longer than all the rest.
    last = np.unique(np.append(even, 1 - 2.0 ** -np.arange(1.0, 13.0)))
    even, last = (jnp.asarray(v, breaks.dtype) for v in (even, last))
    times = breaks[:-2, None] + jnp.diff(breaks)[:-1, None] * even[None, :]
    graded = breaks[-2] + (breaks[-1] - breaks[-2]) * last
    return jnp.concatenate([times.reshape(-1), graded, breaks[-1:]])


class Gains(NamedTuple):
    """Costate and control per deviation of state, parameters and target, at one time."""

    S: Float[Array, "n known"]
    K: Float[Array, "m known"]
    time: Float[Array, " known"]
    rounding: Float[Array, ""]


@functools.partial(jax.jit, static_argnames="free_time")
def gains_at(sweep: Sweep, c: Canonical, t: Array, free_time: bool) -> Gains:
    """S = -G_lambda^-1 [G_x G_p G_target] and K = U_x + U_lambda S at `t`, unscaled."""
    two_n = sweep.scale.shape[0]
    n = two_n // 2
    G = sweep.rows(t)
    known = jnp.concatenate([G[:n, :n], G[:n, two_n:]], axis=1)
    inverse = gauss_solve(G[:n, n:two_n], jnp.eye(n, dtype=G.dtype))
    S = -inverse @ known
    # One step of refinement, and Skeel's bound of what rounding leaves.
    S = S - inverse @ (G[:n, n:two_n] @ S + known)
    size = jnp.abs(inverse) @ (jnp.abs(G[:n, n:two_n]) @ jnp.abs(S) + jnp.abs(known))
    rounding = jnp.finfo(G.dtype).eps * jnp.max(size) / jnp.max(jnp.abs(S) + 1e-300)
    width = jnp.concatenate([sweep.scale[:n], jnp.ones(known.shape[1] - n, G.dtype)])
    S = sweep.scale[n:, None] * S / width[None, :]
    direct = jnp.concatenate(
        [
            c.U[:, :n],
            c.U_p,
            jnp.zeros((c.U.shape[0], known.shape[1] - n - c.U_p.shape[1]), G.dtype),
        ],
        axis=1,
    )
    K = direct + c.U[:, n:] @ S
    if free_time:
        row = G[n]
        y = row[n:two_n] / sweep.scale[n:]
        rest = jnp.concatenate([row[:n], row[two_n:]]) / width
        time = rest + y @ S
    else:
        time = jnp.zeros(known.shape[1], G.dtype)
    return Gains(S, K, time, rounding)


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
        rows = _orthonormal_rows(G, n, two_n)
        start = jnp.concatenate([jnp.eye(n, dtype=G.dtype), -gauss_solve(G[:, n:], G[:, :n])])
        z = left @ jnp.where(i == first, start, y - rows.T @ (rows @ y))
        # inverse of [[a, b], [c, d]] symplectic is [[d^T, -b^T], [-c^T, a^T]]
        a, b, c, d = right[:n, :n], right[:n, n:], right[n:, :n], right[n:, n:]
        moved = jnp.concatenate([d.T @ z[:n] - b.T @ z[n:], a.T @ z[n:] - c.T @ z[:n]])
        return jnp.where((r > l) | (i == first), moved, y), None

    first = sweep.locate(t_from)
    start = jnp.eye(two_n, n, dtype=sweep.ends.dtype)
    y, _ = jax.lax.scan(step, start, jnp.arange(sweep.ends.shape[0], dtype=first.dtype))
    return sweep.scale[:, None] * y / sweep.scale[None, :n]
