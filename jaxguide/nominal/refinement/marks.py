"""Where a solution is not smooth besides the arcs' ends: kinks of the problem's own functions, and
points at which a state or path constraint just touches its bound. Breaks belong there. Host only.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxguide.bounds import bounds_of
from jaxguide.problem.points import rates
from jaxguide.spectral.grids import capacity_weights, differentiation, evaluation, legendre
from jaxguide.trajectory import Extremal

_POINTS = (
    64  # of a segment at which its functions are looked at, and of each closer look. A choice.
)
# A kink's fourth difference is this many times the median of those around it. Smooth functions have
# such peaks too, in layers; looked at more closely they have none. By experiment.
_PEAK = 30.0
# Closer looks, each 16 times closer, the last to 1e-7 of a segment; the first of them must show the
# peak again, of the others rounding may hide it.
_LOOKS, _SURE = 5, 3
_NOISE = 1e-13  # fourth differences below this share of the largest value are rounding
_SAME = 1e-9  # of the horizon: times that are one
# A node nearer to a bound than this share of a value's range rides on it. A choice: the barrier
# holds touching nodes further away than riding ones.
_RIDES = 1e-5


class _Samples(NamedTuple):
    """Polynomials and functions of some segments at points of each, in tau on [-1, 1]."""

    tau: Float[np.ndarray, "segment point"]
    x: Float[np.ndarray, "segment point n"]
    functions: Float[np.ndarray, "segment point function"]  # dynamics, running cost
    path: Float[np.ndarray, "segment point p"]
    steered: Bool[np.ndarray, " p"]  # path constraints that depend on a control


def marks_of(
    extremal: Extremal, errors: Float[np.ndarray, " segment"], tolerance: float
) -> Float[np.ndarray, " mark"]:
    """Fractions of the horizon, in segments whose error is above `tolerance`, at which there is a
    kink of the dynamics or the running cost along the trajectory, or at which a state or path
    constraint oversteps its bound most, between nodes that do not ride on it.

    **Error:** of kinks, 1e-7 of a segment; of touching points the trajectory's own, of which the
    next mesh leaves the square.
    """
    poor = np.flatnonzero(errors > tolerance)
    breaks = np.asarray(extremal.breaks)
    if not len(poor) or extremal.stretch is not None:
        return np.zeros(0)
    tau = np.broadcast_to(np.linspace(-1.0, 1.0, _POINTS + 1), (len(poor), _POINTS + 1))
    samples = _sampled(extremal, poor, tau)
    found = []
    for s, at in (*_kinks(extremal, poor, samples), *_touches(extremal, poor, samples, tolerance)):
        found.append(breaks[s] + (breaks[s + 1] - breaks[s]) * (at + 1) / 2)
    times = np.unique(np.array(found))
    fractions = (times - breaks[0]) / (breaks[-1] - breaks[0])
    if not len(fractions):
        return fractions
    apart = np.append(True, np.diff(fractions) > _SAME)
    return fractions[apart & (fractions > _SAME) & (fractions < 1 - _SAME)]


def settled(extremal: Extremal, marks: Float[np.ndarray, " mark"]) -> Float[np.ndarray, " mark"]:
    """`marks`, breaks of `extremal` as fractions, those at which a state or path constraint touches
    its bound moved to where its derivative vanishes: by Newton's method, one step."""
    problem, breaks, out = extremal.problem, np.asarray(extremal.breaks), marks.copy()
    nodes, horizon = np.asarray(extremal.reference_nodes), breaks[-1] - breaks[0]
    at = np.searchsorted(breaks, breaks[0] + marks * horizon - _SAME * horizon)
    sides = np.unique(np.concatenate([at - 1, at]))
    samples = _sampled(extremal, sides, np.tile(nodes, (len(sides), 1)))
    kinds = (
        (samples.x, problem.state_bounds),
        (np.where(samples.steered, np.nan, samples.path), problem.path_bounds),
    )
    slope = differentiation(nodes, capacity_weights(nodes))
    for values, bounds in kinds:
        lo, hi = (np.asarray(b) for b in bounds_of(bounds, values.shape[2], float))
        size = np.maximum(np.ptp(values, axis=(0, 1)), np.finfo(float).tiny)
        near = np.minimum(values - lo, hi - values) / size < _RIDES
        for j, k in enumerate(at):
            left, right = np.searchsorted(sides, (k - 1, k))
            for i in np.flatnonzero(near[left, -1] & ~near[left, -3] & ~near[right, 2]):
                half = np.diff(breaks)[[k - 1, k]] / 2
                once = [slope @ values[s, :, i] / h for s, h in zip((left, right), half)]
                twice = [slope @ v / h for v, h in zip(once, half)]
                curve = (twice[0][-1] + twice[1][0]) / 2
                step = -(once[0][-1] + once[1][0]) / 2 / curve if curve else 0.0
                out[j] = marks[j] + np.clip(step, *(np.array([-1, 1]) * half / 2)) / horizon
    return out


def _sampled(extremal: Extremal, segments: Any, tau: Float[np.ndarray, "segment k"]) -> _Samples:
    nodes, breaks = np.asarray(extremal.reference_nodes), np.asarray(extremal.breaks)
    x = np.asarray(extremal.by_segment(extremal.x))[segments]
    u = np.asarray(extremal.control_by_segment())[segments]
    rows = np.stack([evaluation(nodes, at) for at in tau])
    x, u = rows @ x, rows @ u
    a, b = breaks[segments][:, None], breaks[np.asarray(segments) + 1][:, None]
    t = a + (b - a) * (tau + 1) / 2
    flat: Any = [np.concatenate(v) for v in (t, x, u)]
    f, cost, path = rates(extremal.stated, *flat)
    other = rates(extremal.stated, flat[0], flat[1], flat[2] + 1)[2] if path.shape[1] else path
    functions = np.concatenate([f, cost[:, None]], axis=1)
    functions, path, other = (v.reshape(*tau.shape, -1) for v in (functions, path, other))
    return _Samples(tau, x, functions, path, np.any(path != other, axis=(0, 1)))


def _kinks(extremal: Extremal, segments: Any, samples: _Samples) -> list[tuple[int, float]]:
    """Segments and tau of kinks inside them."""
    width = 2.0 / _POINTS
    places = [
        (row, samples.tau[row, k])
        for row, values in enumerate(samples.functions)
        for k in _peaks(values, alone=False)
    ]
    for look in range(_LOOKS):
        if not places:
            return []
        rows = np.array([row for row, _ in places])
        # Two points to either side.
        tau = width * np.linspace(-2.0, 2.0, _POINTS + 1)[None]
        tau = tau + np.array([at for _, at in places])[:, None]
        close = _sampled(extremal, np.asarray(segments)[rows], tau)
        peaks = [_peaks(values, alone=True) for values in close.functions]
        places = [
            (row, close.tau[i, peak[0]] if peak else at)
            for i, ((row, at), peak) in enumerate(zip(places, peaks, strict=True))
            if peak or look >= _SURE
        ]
        width = 4.0 * width / _POINTS
    return [(int(segments[row]), float(at)) for row, at in places if -1 < at < 1]


def _peaks(values: Float[np.ndarray, "point k"], alone: bool) -> list[int]:
    """Points next to which a function has a kink; only the clearest, if `alone`."""
    fourth = np.abs(np.diff(values, 4, axis=0))
    floor = _NOISE * np.max(np.abs(values), axis=0) + np.finfo(float).tiny
    middle = np.maximum(np.median(fourth, axis=0), floor)
    height = np.max(fourth / middle, axis=1)
    height = np.where(np.isfinite(height), height, 0.0)
    if alone:
        k = int(np.argmax(height))
        return [k + 2] if height[k] > _PEAK else []
    top = np.flatnonzero(height > _PEAK)
    groups = np.split(top, 1 + np.flatnonzero(np.diff(top) > 1))
    return [int(g[np.argmax(height[g])]) + 2 for g in groups if len(g)]


def _touches(
    extremal: Extremal, segments: Any, samples: _Samples, tolerance: float
) -> list[tuple[int, float]]:
    """Segments and tau of the largest overstep inside them, of bounds that no run of nodes rides
    on."""
    problem, out = extremal.problem, []
    own = np.abs(legendre(np.asarray(extremal.reference_nodes))[0]) > _SAME
    x = np.asarray(extremal.by_segment(extremal.x))[segments][:, own]
    ends = _sampled(
        extremal, segments, np.tile(np.asarray(extremal.reference_nodes)[own], (len(segments), 1))
    )
    kinds = (
        (samples.x, x, problem.state_bounds),
        (samples.path, ends.path, problem.path_bounds),
    )
    for between, at_nodes, bounds in kinds:
        if not between.shape[2]:
            continue
        if between is samples.path:  # what a control can keep does not just touch
            between = np.where(samples.steered, np.nan, between)
        lo, hi = (np.asarray(b) for b in bounds_of(bounds, between.shape[2], float))
        size = np.maximum(np.ptp(between, axis=(0, 1)), np.finfo(float).tiny)
        for values, nodes in ((lo - between, lo - at_nodes), (between - hi, at_nodes - hi)):
            over, riding = values / size, np.sum(nodes / size > -_RIDES, axis=1) > 2
            over = np.where(np.isfinite(over), over, 0.0)
            k = np.argmax(over, axis=1)
            for row, i in zip(*np.nonzero(np.max(over, axis=1) > tolerance), strict=True):
                j = k[row, i]
                if 0 < j < _POINTS and not riding[row, i]:
                    a, b, c = over[row, j - 1 : j + 2, i]
                    step = (a - c) / (2 * (a - 2 * b + c))  # the vertex of a parabola
                    out.append((int(segments[row]), samples.tau[row, j] + step * 2 / _POINTS))
    return out
