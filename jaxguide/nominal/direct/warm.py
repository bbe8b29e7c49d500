"""Multipliers of a nearby extremal as a start: the covector mapping of `covectors`, inverted."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, put, xp
from jaxguide.nominal.direct.guess import fractions_at, interpolated, points_between
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.trees import zeros_like
from jaxguide.nominal.direct.unknowns import Equations, Primal
from jaxguide.trajectory import Extremal


def blank_duals(program: Transcription, w: Primal) -> tuple[Equations, Primal]:
    """Multipliers of zero: of the constraints, and net ones of the bounds."""
    counts = program.counts
    rows = program.rule.A.shape[0]
    defect = xp.zeros((counts.segments, rows, counts.n), program.dtype)
    zeros = zeros_like(w)
    return Equations(defect, zeros.path, zeros.end), zeros


def fits(program: Transcription, guess: Extremal) -> bool:
    """Whether `guess` has as many covectors as this problem has states and constraints."""
    counts, m = program.counts, guess.multipliers
    ends = m.endpoint.shape[0] + m.integral.shape[0]
    return (
        guess.costate.shape[1] + m.integral.shape[0] == counts.n
        and ends == counts.end - len(program.order)
        and m.path.shape[1] == counts.path
    )


def duals(
    program: Transcription, fractions: Float[Array, " edge"], w: Primal, guess: Extremal
) -> dict[str, Any]:
    """The multipliers of `guess` on this mesh, as fields `y` and `net` of a Start.

    **Source:** Ross & Karpenko, review (2012), Proposition 1 and Remark 3, from costates to
    multipliers.
    """
    counts, rule, scale, dtype = program.counts, program.rule, program.scale, program.dtype
    t0, tf = guess.t[0], guess.t[-1]
    times = t0 + (tf - t0) * fractions_at(fractions, np.append(rule.nodes, 1.0))
    m, r = guess.multipliers, guess.multipliers.integral
    defect = _defect_multipliers(program, guess, times)

    # Multipliers along the nodes are densities in time: times the weight and dt/dtau.
    weight = xp.asarray(rule.w, dtype)[None, :, None]
    spans = program.clocks @ w.times
    clock = weight * ((spans[:, 1] - spans[:, 0]) / 2)[:, None, None] * scale.t / scale.objective
    held = xp.concatenate([m.path, m.state, m.control], axis=1)
    held = interpolated(guess, held, times[:, :-1])
    path, state, control = xp.split(held, np.cumsum([m.path.shape[1], m.state.shape[1]]), axis=2)
    wide = lambda a, k: xp.pad(a, ((0, 0), (0, 0), (0, k - a.shape[2])))
    path = path * clock * scale.path[None, None]
    end = xp.concatenate([m.endpoint, r]) / scale.objective
    end = xp.pad(end, (0, counts.end - end.shape[0])) * scale.end
    on_states = xp.zeros_like(w.x)
    first = 1 - rule.first  # the first node that follows the segment's start
    state = wide(state, counts.n) * clock * scale.x[None, None]
    on_states = put(on_states, np.s_[:, : counts.nodes - first], state[:, first:])
    net = zeros_like(w)._replace(
        x=on_states, u=wide(control, counts.m) * clock * scale.u[None, None], path=path, end=end
    )
    return {"y": Equations(defect, path, end), "net": net}


def _defect_multipliers(
    program: Transcription, guess: Extremal, times: Float[Array, "segment k"]
) -> Float[Array, "segment row n"]:
    """-w lambda at the nodes: review (2012), Remark 3; `times` of the nodes and of the ends."""
    counts, rule, scale, dtype = program.counts, program.rule, program.scale, program.dtype
    r = guess.multipliers.integral
    costate = points_between(guess, times).costate
    # The costate of an integral is its multiplier, constant in time.
    constant = xp.broadcast_to(r, (*costate.shape[:2], r.shape[0]))
    lam = xp.concatenate([costate, constant], axis=2) * (scale.x / scale.objective)[None, None]
    weight = xp.asarray(rule.w, dtype)[None, :, None]
    nodal, end = lam[:, :-1], lam[:, -1:]
    if rule.A.shape[0] > counts.nodes:  # LG: the last row is the quadrature to the end
        return xp.concatenate([-weight * (nodal - end), -end], axis=1)
    return -weight * nodal
