"""The arcs of an extremal: where bounds and constraints become active or let go. Host only."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxguide.bounds import bounds_of
from jaxguide.problem.points import rates
from jaxguide.spectral.either import to_legendre
from jaxguide.trajectory import Extremal

# A bound is active where a value comes nearer to it than this share of the distance between the
# bounds, or of the value's own range. Controls get more room: on short segments their multipliers
# have little weight, so that the barrier holds them further away. By experiment on the library.
_NEAR, _NEAR_CONTROL = 1e-4, 1e-2
_SAME = 1e-12  # a range below this share of the largest value is rounding: the value is constant
# Shortest run of nodes counted as an arc: 2 nodes and 0.2 % of the horizon (by experiment on the
# library). A shorter run is a junction seen through a coarse mesh.
_LEAST, _SHARE = 2, 2e-3
# An arc that free knots made shorter than this share of the horizon is gone. Knots keep 1e-6 apart.
_CLOSED = 1e-5
_WEIGHTLESS = 1e-9  # a weight below it is that of a point which is no node of the quadrature
# How far beyond its segment, in half lengths of it, a multiplier's polynomial is trusted to show
# its zero. A choice: at 2 a polynomial of degree 11 has lost some six digits.
_FURTHEST = 2.0
# A multiplier of the wrong sign below this share of its control's largest is the error that a
# junction leaves at its neighbouring nodes. By experiment on NPSAT1 and the robot arm.
_ROUNDING = 1e-7


class Arcs(NamedTuple):
    """`junctions`: times between arcs. `active`: by arc and component (controls, states, path
    constraints), -1 at its lower bound, 1 at its upper, 0 between."""

    junctions: Float[np.ndarray, " junction"]
    active: Float[np.ndarray, "arc component"]

    def switches(self, m: int) -> Bool[np.ndarray, " junction"]:
        """Which junctions are of the `m` controls, the first components."""
        return np.any(np.diff(self.active[:, :m], axis=0), axis=1)

    def kinks(self, affine: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " junction"]:
        """Which junctions are of controls that meet or leave a bound with a kink: all that change
        there do, and H is not linear in any of them (`affine` says in which it is), so that its
        minimiser is continuous."""
        before, after = self.active[:-1, : len(affine)], self.active[1:, : len(affine)]
        changed = before != after
        jumps = changed & (affine[None] | (before * after != 0))
        return np.any(changed, axis=1) & ~np.any(jumps, axis=1)


def arcs(extremal: Extremal) -> Arcs:
    """The active sets along `extremal`, from its nodes."""
    problem = extremal.problem
    # Points that are no nodes of the quadrature hold extrapolated controls.
    own = np.abs(to_legendre(extremal.reference_nodes)[0]) > _WEIGHTLESS
    t = extremal.by_segment(extremal.t[:, None])[..., 0]
    x, u = extremal.by_segment(extremal.x), extremal.control_by_segment()
    flat: Any = lambda a: np.concatenate(a[:, own])
    t, x, u = map(flat, (t, x, u))
    h: Any = rates(extremal.stated, t, x, u)[2]
    labels = [
        _near(u, problem.control_bounds, _NEAR_CONTROL),
        _near(x, problem.state_bounds, _NEAR),
        _near(h, problem.path_bounds, _NEAR),
    ]
    return _cut(np.asarray(t), np.concatenate(labels, axis=1))


def _near(values: Any, bounds: Any, share: float) -> np.ndarray:
    """`values` (node, k): -1 near the lower bound, 1 near the upper, 0 between."""
    lo, hi = (np.asarray(b) for b in bounds_of(bounds, values.shape[1], values.dtype))
    span = np.maximum(np.ptp(values, axis=0), _SAME * np.max(np.abs(values), axis=0))
    near = share * np.minimum(hi - lo, span)
    active = np.where(values - lo <= near, -1, 0) + np.where(hi - values <= near, 1, 0)
    return np.where(hi > lo, active, 0)  # an equality has no arcs


def without_collapsed(found: Arcs, edges: Float[np.ndarray, " edge"]) -> Arcs:
    """`found`, whose arcs free knots have moved to `edges` (ends included), without the arcs that
    they closed."""
    long = np.diff(edges) >= _CLOSED * (edges[-1] - edges[0])
    keep = np.flatnonzero(long)
    # Two arcs that hold the same, once the arc between them is gone, are one.
    same = [np.array_equal(found.active[a], found.active[b]) for a, b in zip(keep, keep[1:])]
    first = keep[np.append(True, ~np.array(same, bool))]
    middle = [(edges[a] + edges[b + 1]) / 2 for a, b in zip(first[1:], _before(keep, first))]
    return Arcs(np.array(middle), found.active[first])


def meeting_points(
    extremal: Extremal, found: Arcs, edges: Int[np.ndarray, " end"], kinks: Bool[np.ndarray, " j"]
) -> Float[np.ndarray, " junction"]:
    """Times at which the controls meet the bounds that `found` holds them on, for its junctions
    that are `kinks`; the others where they are. `edges`: the arcs' ends among the breaks.

    There the multiplier of the bound, -H_u, vanishes along the states and costates of the arc that
    is held. The zero of its polynomial errs by the square of the junction's present error: an arc
    too long by d has a control that is wrong by a multiple of d over a time of d.
    """
    breaks, out = np.asarray(extremal.breaks), found.junctions.copy()
    multiplier = np.asarray(extremal.by_segment(extremal.multipliers.control))
    own = np.abs(to_legendre(extremal.reference_nodes)[0]) > _WEIGHTLESS
    tau = np.asarray(extremal.reference_nodes)[own]
    m = multiplier.shape[2]
    for j in np.flatnonzero(kinks):
        before, after, moves = found.active[j, :m], found.active[j + 1, :m], []
        for k in np.flatnonzero(before != after):
            s, end = (edges[j + 1] - 1, 1.0) if before[k] else (edges[j + 1], -1.0)
            half = (breaks[s + 1] - breaks[s]) / 2
            series = np.polynomial.Legendre.fit(tau, multiplier[s, own, k], len(tau) - 1, [-1, 1])
            moves.append(half * _nearest_zero(series, end))
        move = moves[int(np.argmax(np.abs(moves)))]
        ahead, behind = breaks[edges[j + 2]] - out[j], out[j] - breaks[edges[j]]
        out[j] += np.clip(move, -behind, ahead)
    return out


def _nearest_zero(series: Any, end: float) -> float:
    """How far from `end` the polynomial `series` has its nearest zero, at most `_FURTHEST`; where
    it has none so near, as far as its tangent at the end says."""
    roots = series.roots()
    real = roots.real[np.abs(roots.imag) <= _SAME + 1e-9 * np.abs(roots.real)] - end
    near = real[np.abs(real) <= _FURTHEST]
    if len(near):
        return float(near[np.argmin(np.abs(near))])
    slope = float(series.deriv()(end))
    step = -float(series(end)) / slope if slope else 0.0
    return float(np.clip(step, -_FURTHEST, _FURTHEST))


def corrected(
    extremal: Extremal,
    found: Arcs,
    edges: Float[np.ndarray, " edge"],
    affine: Bool[np.ndarray, " m"],
) -> Arcs:
    """`found`, its arcs at `edges` (ends included), corrected by the multipliers of the controls: a
    control held at one bound goes to the other where the sign of its multiplier says so, or leaves
    both unless H is linear in it (`affine`). Two controls that one junction switches together then
    switch each at its own multiplier's zero."""
    problem, m = extremal.problem, extremal.problem.m
    nodal = (extremal.t, extremal.x, extremal.u, extremal.multipliers.control)
    t = _own(extremal, extremal.t)
    # A junction's node belongs to the arcs on both its sides: it says nothing.
    inside = np.min(np.abs(t[:, None] - edges[None]), axis=1) > 1e-9 * np.ptp(edges)
    t, x, u, multiplier = (_own(extremal, a)[inside] for a in nodal)
    arc = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(found.active) - 1)
    labels = found.active[arc].copy()
    clear = np.abs(multiplier) > _ROUNDING * np.max(np.abs(multiplier), axis=0)
    # Where H is not linear in the control, it leaves the bound for a value between.
    other = np.where(affine | (np.sign(multiplier) == labels[:, :m]), np.sign(multiplier), 0)
    held = np.where((labels[:, :m] != 0) & clear, other, labels[:, :m])
    changed = np.any(held != labels[:, :m], axis=1, keepdims=True)
    lo, hi = (np.asarray(b) for b in bounds_of(problem.control_bounds, m, u.dtype))
    u: Any = np.where(held > 0, hi, np.where(held < 0, lo, u))
    h: Any = rates(extremal.stated, t, x, u)[2]
    path = labels[:, m + problem.n :]
    path = np.where(changed, _near(h, problem.path_bounds, _NEAR), path)
    labels = np.concatenate([held, labels[:, m : m + problem.n], path], axis=1)
    return _runs(t, labels, least=lambda a, b: True)


def _own(extremal: Extremal, values: Any) -> Any:
    """`values` (node, ...) at the nodes of the quadrature alone, segment after segment."""
    flat = values.reshape(values.shape[0], -1)
    own = np.abs(to_legendre(extremal.reference_nodes)[0]) > _WEIGHTLESS
    by_segment = np.asarray(extremal.by_segment(flat))[:, own]
    return by_segment.reshape(-1, *values.shape[1:])


def _before(keep: np.ndarray, first: np.ndarray) -> list[int]:
    """Of each arc in `first` but the first, the last arc of `keep` ahead of it."""
    return [int(keep[np.searchsorted(keep, k) - 1]) for k in first[1:]]


def _cut(t: np.ndarray, labels: np.ndarray) -> Arcs:
    """Arcs: runs of equal labels. A short run is divided between its neighbours."""
    labels = np.stack([_calmed(t, column) for column in labels.T], axis=1)
    return _runs(t, labels, functools.partial(_lasts, t))


def _runs(t: np.ndarray, labels: np.ndarray, least: Callable[[Any, Any], Any]) -> Arcs:
    """Arcs: runs of equal labels, nodes a ... b - 1, for which `least(a, b)` holds. The others are
    divided between their neighbours."""
    starts = np.concatenate([[0], 1 + np.flatnonzero(np.any(np.diff(labels, axis=0), axis=1))])
    ends = np.append(starts[1:], len(t))
    long = [(a, b) for a, b in zip(starts, ends, strict=True) if least(a, b)]
    merged: list[tuple[int, int]] = []
    for a, b in long:
        if merged and np.array_equal(labels[merged[-1][0]], labels[a]):
            merged[-1] = (merged[-1][0], b)
        else:
            merged.append((a, b))
    junctions = [(t[b - 1] + t[a]) / 2 for (_, b), (a, _) in zip(merged, merged[1:], strict=False)]
    active = [labels[a] for a, _ in merged]
    return Arcs(np.array(junctions), np.array(active))


def _lasts(t: np.ndarray, a: Any, b: Any) -> Any:
    """Whether nodes a ... b - 1 are an arc."""
    return b - a >= _LEAST and bool(t[b - 1] - t[a] >= _SHARE * (t[-1] - t[0]))


def _calmed(t: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels of one component; a run too short for an arc takes the label before it."""
    starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(labels)), [len(labels)]])
    out = labels.copy()
    for a, b in zip(starts[1:-1], starts[2:], strict=True):
        if not _lasts(t, a, b):
            out[a:b] = out[a - 1]
    return out
