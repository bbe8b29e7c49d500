"""Two backward sweeps about an extremal: the second, finer one shows the error of the first."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.linalg import cholesky_positive
from jaxguide.neighboring.breaks import balancing_scale, place_breaks, probe_times
from jaxguide.neighboring.linearization import Canonical, Terminal, canonical, second_variation
from jaxguide.neighboring.sweep import Sweep, collocate, identity, join
from jaxguide.problem import Problem, is_free
from jaxguide.spectral import interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal, Point

# The defaults: gains of Earth-Mars, whose control turns sharply, to 4e-10 (`bench/gains.py`).
SEGMENTS, NODES, SWEEPS = 72, 8, 8
# Gauss points more in the finer sweep (chosen, not tuned), and its Picard sweeps: starting from the
# coarser solution, few show the difference (by experiment; on which problems is not recorded).
_FINER, _FINER_SWEEPS = 2, 5


@functools.partial(jax.jit, static_argnames="parameters")
def canonical_at(
    problem: Problem, t: Array, point: Point, parameters: tuple[str, ...]
) -> tuple[Canonical, Bool[Array, ""]]:
    """The linear canonical system at one point of the extremal, and whether H_uu is positive
    definite there."""
    v = second_variation(problem, t, point.x, point.u, point.costate, parameters)
    return canonical(v), cholesky_positive(v.H_uu)


class SweepPair(NamedTuple):
    """A sweep, a finer one beside it, and the canonical system at the requested times."""

    sweep: Sweep
    finer: Sweep
    at_times: Canonical
    state: Float[Array, "time n"]  # of the extremal, at the requested times
    control: Float[Array, "time m"]
    convex: Bool[Array, " segment"]  # H_uu positive definite at the segment's nodes


def solve_sweeps(
    extremal: Extremal,
    terminal: Terminal,
    times: Float[Array, " time"],
    segments: int,
    nodes: int,
    sweeps: int,
    parameters: tuple[str, ...],
) -> SweepPair:
    """The adjoint rows on `nodes` and on `nodes + 2` Gauss points a segment.

    Both are stored on the finer points (a polynomial of lower degree is exact there), so that
    everything after works on the pair at once.
    """
    problem, counts = extremal.problem, (nodes, nodes + _FINER)
    probes = probe_times(extremal)
    M = jax.vmap(lambda t: canonical_at(problem, t, extremal.point(t), ())[0].M)(probes)
    scale = balancing_scale(extremal, M)
    ratio = scale[None, :] / scale[:, None]
    breaks = place_breaks(probes, M * ratio[None], segments)

    grids = [_gauss_times(breaks, s) for s in counts]
    everywhere = jnp.concatenate([grids[0].reshape(-1), grids[1].reshape(-1), times])
    points = extremal(everywhere)
    at_points = jax.vmap(lambda t, point: canonical_at(problem, t, point, parameters))
    c, convex = at_points(everywhere, points)
    M = jnp.concatenate([c.M * ratio[None], c.b / scale[None, :, None]], axis=2)
    first, both = counts[0] * segments, sum(counts) * segments
    by_node = lambda a, s: a.reshape(s, segments, scale.shape[0], -1).transpose(0, 2, 3, 1)
    coarse, fine = by_node(M[:first], counts[0]), by_node(M[first:both], counts[1])

    slopes, begins = _transitions(coarse, fine, breaks, grids[0], grids[1], sweeps)
    ends = _joined(extremal, terminal, scale, begins)
    finer_nodes = jnp.asarray(nodes_lg(counts[1])[0], breaks.dtype)
    pair = [
        Sweep(finer_nodes, breaks, slope.transpose(3, 0, 1, 2), ends[i], scale)
        for i, slope in enumerate(slopes)
    ]
    at_times = jax.tree_util.tree_map(lambda a: a[both:], c)
    convex = jnp.all(convex[:first].reshape(counts[0], segments), axis=0)
    return SweepPair(pair[0], pair[1], at_times, points.x[both:], points.u[both:], convex)


def _gauss_times(breaks: Float[Array, " edge"], s: int) -> Float[Array, "s segment"]:
    middle, half = (breaks[1:] + breaks[:-1]) / 2, jnp.diff(breaks) / 2
    return middle[None, :] + half[None, :] * jnp.asarray(nodes_lg(s)[0], breaks.dtype)[:, None]


def _transitions(
    coarse: Float[Array, "s two_n w segment"],
    fine: Float[Array, "f two_n w segment"],
    breaks: Float[Array, " edge"],
    coarse_times: Float[Array, "s segment"],
    fine_times: Float[Array, "f segment"],
    sweeps: int,
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """For both systems, the slopes (Phi - I)/(t_e - t) at the finer Gauss points, and the
    transitions across the segments."""
    widths = jnp.diff(breaks)
    eye = identity((coarse.shape[1], coarse.shape[2]), coarse.dtype)[None, :, :, None]
    gap = lambda t: (breaks[1:][None, :] - t)[:, None, None, :]
    slope = lambda psi, gap: (psi - eye) / jnp.where(gap > 0, gap, 1.0)
    taus = [jnp.asarray(nodes_lg(M.shape[0])[0], breaks.dtype) for M in (coarse, fine)]

    psi, begin = collocate(coarse, widths, None, sweeps)
    slopes = jnp.tensordot(interpolation_matrix(*taus), slope(psi, gap(coarse_times)), 1)
    left = gap(fine_times)
    psi, finer_begin = collocate(fine, widths, eye + left * slopes, _FINER_SWEEPS)
    return (slopes, slope(psi, left)), (begin, finer_begin)


def _joined(
    extremal: Extremal, terminal: Terminal, scale: Float[Array, " two_n"], begins: tuple
) -> Float[Array, "pair segment row w"]:
    """G at the segments' ends, scaled, of both sweeps: rows of the end conditions, then of a free
    final time; columns of the state and costate, the parameters and the target."""
    n, q = extremal.problem.n, terminal.psi_target.shape[1]
    p = terminal.psi_p.shape[1]
    columns = jnp.concatenate([scale, jnp.ones(p + q, scale.dtype)])
    rows = jnp.concatenate([terminal.psi, terminal.psi_p, terminal.psi_target], axis=1)
    if is_free(extremal.problem.final_time):
        rows = jnp.concatenate([rows, terminal.time[None]])
    rows = rows * columns[None, :]
    padded = jnp.pad(jnp.stack(begins), ((0, 0), (0, 0), (0, q), (0, 0)))
    return jax.vmap(lambda begin: join(rows, begin, n))(padded)
