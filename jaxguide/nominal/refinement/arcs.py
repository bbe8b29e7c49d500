"""The arcs of an extremal: where bounds and constraints become active or let go. Host only."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.bounds import bounds_of
from jaxguide.conditions.hamiltonian import hamiltonian
from jaxguide.nominal.direct.unknowns import Arcwise
from jaxguide.spectral import legendre_matrix
from jaxguide.trajectory import Extremal

# As near to a bound as this, of its range, it is active; controls are let off lightly, where short
# segments give their multipliers little weight.
_NEAR, _NEAR_CONTROL = 1e-4, 1e-2
# What an arc holds at least, else it is the blur of a junction: nodes, and a share of the horizon.
_LEAST, _SHARE = 2, 2e-3
# Shorter arcs, of the horizon, are what free knots closed: they stop at 1e-6.
_CLOSED = 1e-5
# Multipliers of the wrong sign below this, of their control's largest, are a junction's own error.
_ROUNDING = 1e-7
_SEGMENTS_A_HORIZON = 8  # of the mesh with free knots
_SMOOTHING = 1e2  # weight of a singular control's roughness, in designer units


class Arcs(NamedTuple):
    """`junctions`: times between arcs. `active`: what each arc holds, component by component: -1 at
    its lower bound, 1 at its upper, 0 between."""

    junctions: Float[np.ndarray, " junction"]
    active: Float[np.ndarray, "arc component"]

    def switches(self, m: int) -> Bool[np.ndarray, " junction"]:
        """Which junctions are of the `m` controls, the first components."""
        return np.any(np.diff(self.active[:, :m], axis=0), axis=1)


def arcs(extremal: Extremal) -> Arcs:
    """The active sets along `extremal`, from its nodes."""
    problem = extremal.problem
    # Points that are no nodes of the quadrature hold extrapolated controls.
    inverse = np.asarray(legendre_matrix(extremal.reference_nodes))
    own = np.abs(inverse[0]) > 1e-9
    t, x, u = (np.asarray(a) for a in _by_segment(extremal))
    flat = lambda a: a[:, own].reshape(-1, *a.shape[2:])
    t, x, u = flat(t), flat(x), flat(u)
    h = np.asarray(jax.vmap(problem.path_constraints)(t, x, u))
    labels = [
        _near(u, problem.control_bounds, _NEAR_CONTROL),
        _near(x, problem.state_bounds, _NEAR),
        _near(h, problem.path_bounds, _NEAR),
    ]
    return _cut(t, np.concatenate(labels, axis=1))


def _near(values: Float[np.ndarray, "node k"], bounds: Any, share: float) -> np.ndarray:
    """-1 near the lower bound, 1 near the upper, 0 between."""
    lo, hi = (np.asarray(b) for b in bounds_of(bounds, values.shape[1], values.dtype))
    near = share * np.minimum(hi - lo, np.ptp(values, axis=0) + 1e-12)
    active = np.where(values - lo <= near, -1, 0) + np.where(hi - values <= near, 1, 0)
    return np.where(hi > lo, active, 0)  # an equality has no arcs


def without_collapsed(found: Arcs, edges: Float[np.ndarray, " edge"]) -> Arcs:
    """`found` with its arcs at `edges` (ends included), but for those that free knots closed."""
    long = np.diff(edges) >= _CLOSED * (edges[-1] - edges[0])
    keep = np.flatnonzero(long)
    # Alike once what stood between them is gone: one arc.
    same = [np.array_equal(found.active[a], found.active[b]) for a, b in zip(keep, keep[1:])]
    first = keep[np.append(True, ~np.array(same, bool))]
    middle = [(edges[a] + edges[b + 1]) / 2 for a, b in zip(first[1:], _before(keep, first))]
    return Arcs(np.array(middle), found.active[first])


def corrected(extremal: Extremal, found: Arcs, edges: Float[np.ndarray, " edge"]) -> Arcs:
    """`found`, its arcs at `edges` (ends included), with controls that are held at one bound where
    their multiplier names the other held there instead. Two controls that one junction switches
    together, for lack of an arc between, come apart: each at its own multiplier's zero."""
    problem, m = extremal.problem, extremal.problem.m
    nodal = (extremal.t, extremal.x, extremal.u, extremal.multipliers.control)
    t = _own(extremal, extremal.t)
    # A junction's node belongs to the arcs on both its sides: it says nothing.
    inside = np.min(np.abs(t[:, None] - edges[None]), axis=1) > 1e-9 * np.ptp(edges)
    t, x, u, multiplier = (_own(extremal, a)[inside] for a in nodal)
    arc = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(found.active) - 1)
    labels = found.active[arc].copy()
    clear = np.abs(multiplier) > _ROUNDING * np.max(np.abs(multiplier), axis=0)
    held = np.where((labels[:, :m] != 0) & clear, np.sign(multiplier), labels[:, :m])
    changed = np.any(held != labels[:, :m], axis=1, keepdims=True)
    lo, hi = (np.asarray(b) for b in bounds_of(problem.control_bounds, m, u.dtype))
    u = np.where(held > 0, hi, np.where(held < 0, lo, u))
    h = np.asarray(jax.vmap(problem.path_constraints)(t, x, u))
    path = labels[:, m + problem.n :]
    path = np.where(changed, _near(h, problem.path_bounds, _NEAR), path)
    labels = np.concatenate([held, labels[:, m : m + problem.n], path], axis=1)
    return _runs(t, labels, least=lambda a, b: True)


def laid_out(
    extremal: Extremal, found: Arcs
) -> tuple[np.ndarray, tuple[int, ...], np.ndarray, Arcwise]:
    """A mesh of the arcs `found`: its breaks as fractions of the horizon, which of them are free
    knots, where the arcs end among them, and what each segment holds."""
    n, m, junctions = extremal.problem.n, extremal.problem.m, found.junctions
    affine, switches = _affine(extremal), found.switches(m)
    t0, tf = float(extremal.t[0]), float(extremal.t[-1])
    main = (np.concatenate([[t0], junctions, [tf]]) - t0) / (tf - t0)
    breaks, knots, edges = [0.0], [], [0]
    held, smooth, released, unpathed = [], [], [], []
    for arc, (a, b) in enumerate(zip(main[:-1], main[1:], strict=True)):
        # A singular arc gets one polynomial: more would let its control chatter.
        singular = affine & (found.active[arc, :m] == 0)
        count = 1 if singular.any() else max(2, int(np.ceil(_SEGMENTS_A_HORIZON * (b - a))))
        breaks += list(a + (b - a) * np.arange(1, count + 1) / count)
        held += [found.active[arc, :m].astype(float)] * count
        smooth += [np.where(singular, _SMOOTHING, 0.0)] * count
        # With every control held a state bound is implied but for one point, the arc's last.
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
    known = Arcwise(*(jnp.asarray(np.array(a)) for a in (held, smooth, released, unpathed)))
    return np.array(breaks), tuple(knots), np.array(edges), known


def _own(extremal: Extremal, values: Any) -> np.ndarray:
    """`values` (node, ...) at the nodes of the quadrature alone, segment after segment."""
    values = np.asarray(values)
    flat = values.reshape(values.shape[0], -1)
    own = np.abs(np.asarray(legendre_matrix(extremal.reference_nodes))[0]) > 1e-9
    by_segment = np.asarray(extremal.by_segment(jnp.asarray(flat)))[:, own]
    return by_segment.reshape(-1, *values.shape[1:])


def _before(keep: np.ndarray, first: np.ndarray) -> list[int]:
    """The last arc that lasts ahead of each but the first of `first`."""
    return [int(keep[np.searchsorted(keep, k) - 1]) for k in first[1:]]


@jax.jit
def _by_segment(extremal: Extremal):
    return (
        extremal.by_segment(extremal.t[:, None])[..., 0],
        extremal.by_segment(extremal.x),
        extremal.control_by_segment(),
    )


def _cut(t: np.ndarray, labels: np.ndarray) -> Arcs:
    """Runs of equal labels; short ones are shared out between their neighbours."""
    labels = np.stack([_calmed(t, column) for column in labels.T], axis=1)
    return _runs(t, labels, functools.partial(_lasts, t))


def _runs(t: np.ndarray, labels: np.ndarray, least: Callable[[Any, Any], Any]) -> Arcs:
    """Runs of equal labels that are `least` long; others are shared out to their neighbours."""
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
    """One component's labels, runs that are no arcs joined to what came before."""
    starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(labels)), [len(labels)]])
    out = labels.copy()
    for a, b in zip(starts[1:-1], starts[2:], strict=True):
        if not _lasts(t, a, b):
            out[a:b] = out[a - 1]
    return out


@eqx.filter_jit
def _curvature(extremal: Extremal) -> Float[Array, "node m"]:
    along = jax.vmap(jax.hessian(hamiltonian, argnums=3), in_axes=(None, 0, 0, 0, 0))
    at = (extremal.problem, extremal.t, extremal.x, extremal.u, extremal.costate)
    return jnp.max(jnp.abs(along(*at)), axis=2)


def _affine(extremal: Extremal) -> np.ndarray:
    """Which controls H is linear in."""
    return np.asarray(jnp.max(_curvature(extremal), axis=0)) <= 1e-12
