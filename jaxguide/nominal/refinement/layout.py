"""A mesh for a structure of arcs: breaks at the junctions, free knots where controls switch."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxguide.nominal.direct.unknowns import Arcwise
from jaxguide.nominal.refinement.arcs import Arcs
from jaxguide.problem.points import control_curvature
from jaxguide.trajectory import Extremal

_SEGMENTS_A_HORIZON = 8  # of the mesh with free knots: a first choice, tried on ten problems
# Weight of a singular control's roughness, in designer units: a first choice, tried on Goddard's
# rocket, Jackson's reactor and the catalyst mixing.
_SMOOTHING = 1e2
_LINEAR = 1e-12  # curvature of H, relative to H, below which it is linear in a control: rounding


class Layout(NamedTuple):
    """`fractions`: breaks as fractions of the horizon; `knots`: which of them are free; `edges`:
    which of them are the arcs' ends; `arcwise`: what each segment holds."""

    fractions: Float[np.ndarray, " edge"]
    knots: tuple[int, ...]
    edges: Int[np.ndarray, " end"]
    arcwise: Arcwise


def laid_out(extremal: Extremal, found: Arcs) -> Layout:
    """A mesh for the arcs `found` along `extremal`."""
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
    known: Any = map(np.array, (held, smooth, released, unpathed))
    return Layout(np.array(breaks), tuple(knots), np.array(edges), Arcwise(*known))


def _affine(extremal: Extremal) -> Bool[np.ndarray, " m"]:
    """Which controls H is linear in."""
    return _curvature(extremal) <= _LINEAR


def _curvature(extremal: Extremal) -> Float[np.ndarray, " m"]:
    """The largest second derivative of H by each control (its row of H_uu), relative to H."""
    e, size = extremal, extremal.sizes()
    h_uu = control_curvature(e.stated, e.t, e.x, e.u, e.costate)
    rows = np.abs(h_uu) * (size.u[:, None] * size.u[None, :])[None]
    return np.max(rows, axis=(0, 2)) / size.hamiltonian
