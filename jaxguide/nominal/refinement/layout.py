"""A mesh for a structure of arcs: breaks at the junctions, free knots where controls switch."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxguide.bounds import bounds_of
from jaxguide.nominal.direct.unknowns import Arcwise
from jaxguide.nominal.refinement.arcs import Arcs
from jaxguide.nominal.refinement.meshes import united
from jaxguide.problem.points import control_curvature, rates
from jaxguide.trajectory import Extremal

_SEGMENTS_A_HORIZON = 8  # of the mesh with free knots: a first choice, tried on ten problems
# Weight of a singular control's roughness, in designer units: a first choice, tried on Goddard's
# rocket, Jackson's reactor and the catalyst mixing.
_SMOOTHING = 1e2
# A value nearer to its bound than this share of its range is on it: the last barrier, 1e-11, holds
# what has a multiplier nearer. What is mistaken for free shows as an overstep. Chosen, not tuned.
_TOUCHES = 1e-7
_SAME = 1e-9  # of the horizon: times that are one
_LINEAR = 1e-12  # curvature of H, relative to H, below which it is linear in a control: rounding


class Layout(NamedTuple):
    """`fractions`: breaks as fractions of the horizon; `knots`: which of them are free; `edges`:
    which of them are the arcs' ends; `arcwise`: what each segment holds."""

    fractions: Float[np.ndarray, " edge"]
    knots: tuple[int, ...]
    edges: Int[np.ndarray, " end"]
    arcwise: Arcwise


def laid_out(
    extremal: Extremal,
    found: Arcs,
    affine: Bool[np.ndarray, " m"],
    inner: list[np.ndarray],
    marks: Float[np.ndarray, " mark"],
    loose: bool = False,
) -> Layout:
    """A mesh for the arcs `found` along `extremal`; `affine`: which controls H is linear in.

    `inner`: the breaks of each arc, from 0 to 1 of it; `marks`: fractions of the horizon at which
    there must be breaks besides. `loose`: whether controls that are on no bound have none, in
    which H is not linear.
    """
    n, m = extremal.problem.n, extremal.problem.m
    switches = found.switches(m) & ~found.kinks(affine)
    main = _main(extremal, found)
    breaks, knots, edges = [0.0], [], [0]
    held, smooth, released, unpathed = [], [], [], []
    for arc, (a, b) in enumerate(zip(main[:-1], main[1:], strict=True)):
        singular = affine & (found.active[arc, :m] == 0)
        within = marks[(marks > a + _SAME) & (marks < b - _SAME)]
        along = united(a + (b - a) * inner[arc], within)
        count = len(along) - 1
        breaks += list(along[1:])
        held += [found.active[arc, :m].astype(float)] * count
        smooth += [np.where(singular, _SMOOTHING, 0.0)] * count
        # Where every control is held, the dynamics imply the states: a state bound that is met
        # along the arc is left to one point, the arc's last.
        settled = np.all(found.active[arc, :m] != 0)
        implied = (found.active[arc, m : m + n] != 0) & settled
        unpathed += [(found.active[arc, m + n :] != 0) & settled] * count
        if released:
            released[-1] = released[-1] | np.stack([np.zeros(n, bool), implied])
        released += [np.stack([implied, implied])] * count
        released[-1] = np.stack([implied, np.zeros(n, bool)])
        edges.append(len(breaks) - 1)
        if arc < len(switches) and switches[arc]:
            knots.append(len(breaks) - 1)
    breaks[-1] = 1.0
    unbounded = _loose(found, found.kinks(affine), np.array(edges), m)
    if loose:
        unbounded |= ((np.array(held) == 0) & ~affine)[:, None]
    known: Any = map(np.array, (held, smooth, released, unpathed, unbounded))
    return Layout(np.array(breaks), tuple(knots), np.array(edges), Arcwise(*known))


def _loose(
    found: Arcs, kinks: Bool[np.ndarray, " junction"], edges: Int[np.ndarray, " end"], m: int
) -> Bool[np.ndarray, "segment two m"]:
    """Lower and upper bounds that controls meet at a kink, in the segment beside it in which they
    are not held."""
    out = np.zeros((edges[-1], 2, m), bool)
    for j in np.flatnonzero(kinks):
        before, after = found.active[j, :m], found.active[j + 1, :m]
        for k in np.flatnonzero(before != after):
            segment = edges[j + 1] - (1 if after[k] else 0)
            out[segment, 0 if before[k] + after[k] < 0 else 1, k] = True
    return out


def without_idle_bounds(extremal: Extremal) -> Arcwise | None:
    """Arcs of nothing but bounds left out: of each control and path constraint that stays away from
    them, and of each state but at the breaks where it touches them. None where states or path
    constraints ride on a bound between breaks, or where a control meets one: that takes a
    structure."""
    problem, breaks = extremal.problem, np.asarray(extremal.breaks)
    h = np.asarray(rates(extremal.stated, extremal.t, extremal.x, extremal.u)[2])
    kinds = (
        (np.asarray(extremal.u), problem.control_bounds),
        (np.asarray(extremal.x), problem.state_bounds),
        (h, problem.path_bounds),
    )
    bounded = any(np.any(np.isfinite(np.asarray(b))) for _, bounds in kinds for b in bounds)
    control, state, path = (_near_bounds(*kind) for kind in kinds)
    on_break = np.arange(len(state)) % extremal.degree == 0
    if not bounded or control.any() or path.any() or state[~on_break].any():
        return None
    segments, m, n = len(breaks) - 1, problem.m, problem.n
    touched = state[on_break][1:]
    released = np.stack([np.ones((segments, n), bool), ~touched], axis=1)
    nothing = np.zeros((segments, m))
    unpathed, loose = np.ones((segments, h.shape[1]), bool), np.ones((segments, 2, m), bool)
    known: Any = (nothing, nothing, released, unpathed, loose)
    return Arcwise(*known)


def _near_bounds(values: Float[np.ndarray, "node k"], bounds: Any) -> Bool[np.ndarray, "node k"]:
    """Where values are nearer to a bound than `_TOUCHES` of their range."""
    lo, hi = (np.asarray(b) for b in bounds_of(bounds, values.shape[1], values.dtype))
    span = np.maximum(np.ptp(values, axis=0), _TOUCHES * np.max(np.abs(values), axis=0))
    return np.minimum(values - lo, hi - values) <= _TOUCHES * span


def inner_breaks(
    extremal: Extremal, found: Arcs, affine: Bool[np.ndarray, " m"]
) -> list[np.ndarray]:
    """Breaks of equal distance in each arc, from 0 to 1 of it."""
    out = []
    for active, share in zip(found.active, np.diff(_main(extremal, found)), strict=True):
        # A singular arc gets one polynomial: more would let its control chatter.
        singular = np.any(affine & (active[: len(affine)] == 0))
        count = 1 if singular else max(2, int(np.ceil(_SEGMENTS_A_HORIZON * share)))
        out.append(np.linspace(0.0, 1.0, count + 1))
    return out


def _main(extremal: Extremal, found: Arcs) -> Float[np.ndarray, " end"]:
    """Ends of the arcs as fractions of the horizon."""
    t0, tf = float(extremal.t[0]), float(extremal.t[-1])
    return (np.concatenate([[t0], found.junctions, [tf]]) - t0) / (tf - t0)


def affine_controls(extremal: Extremal) -> Bool[np.ndarray, " m"]:
    """Which controls H is linear in."""
    return _curvature(extremal) <= _LINEAR


def _curvature(extremal: Extremal) -> Float[np.ndarray, " m"]:
    """The largest second derivative of H by each control (its row of H_uu), relative to H."""
    e, size = extremal, extremal.sizes()
    h_uu = control_curvature(e.stated, e.t, e.x, e.u, e.costate)
    rows = np.abs(h_uu) * (size.u[:, None] * size.u[None, :])[None]
    return np.max(rows, axis=(0, 2)) / size.hamiltonian
