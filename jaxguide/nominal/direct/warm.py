"""Multipliers of a nearby extremal as a start: the covector mapping undone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.nominal.direct.guess import fractions_at
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal, Rows
from jaxguide.trajectory import Extremal


def blank_duals(program: Transcription, w: Primal) -> tuple[Rows, Primal]:
    """No multipliers."""
    size = program.sizes
    defect = jnp.zeros((size.segments, program.rule.A.shape[0], size.n), program.dtype)
    zeros = jax.tree_util.tree_map(jnp.zeros_like, w)
    return Rows(defect, zeros.path, zeros.end), zeros


def fits(program: Transcription, guess: Extremal) -> bool:
    """Whether the covectors of `guess` are those of this problem's constraints."""
    size, m = program.sizes, guess.multipliers
    ends = m.endpoint.shape[0] + m.integral.shape[0]
    return (
        guess.costate.shape[1] + m.integral.shape[0] == size.n
        and ends == size.end - len(program.order)
        and m.path.shape[1] == size.path
    )


def duals(
    program: Transcription, fractions: Float[Array, " edge"], w: Primal, guess: Extremal
) -> dict[str, Any]:
    """`costates` and the multipliers of `to_extremal` undone: those of `guess` on this mesh."""
    size, rule, scale, dtype = program.sizes, program.rule, program.scale, program.dtype
    t0, tf = guess.t[0], guess.t[-1]
    times = t0 + (tf - t0) * fractions_at(fractions, np.append(rule.nodes, 1.0))
    m, r = guess.multipliers, guess.multipliers.integral
    costate = jax.vmap(jax.vmap(guess.point))(times).costate
    # An integral's costate is its multiplier, all along.
    constant = jnp.broadcast_to(r, (*costate.shape[:2], r.shape[0]))
    lam = jnp.concatenate([costate, constant], axis=2) * (scale.x / scale.objective)[None, None]
    weight = jnp.asarray(rule.w, dtype)[None, :, None]
    nodal, end = lam[:, :-1], lam[:, -1:]
    defect = -weight * nodal
    if rule.A.shape[0] > size.nodes:  # LG: the last row is the quadrature to the end
        defect = jnp.concatenate([-weight * (nodal - end), -end], axis=1)
    spans = program.clocks @ w.times
    clock = weight * ((spans[:, 1] - spans[:, 0]) / 2)[:, None, None] * scale.t / scale.objective
    held = jnp.concatenate([m.path, m.state, m.control], axis=1)
    held = jax.vmap(jax.vmap(lambda t: guess.interpolate(held, t)))(times[:, :-1])
    path, state, control = jnp.split(held, np.cumsum([m.path.shape[1], m.state.shape[1]]), axis=2)
    wide = lambda a, k: jnp.pad(a, ((0, 0), (0, 0), (0, k - a.shape[2])))
    path = path * clock * scale.path[None, None]
    end = jnp.concatenate([m.endpoint, r]) / scale.objective
    end = jnp.pad(end, (0, size.end - end.shape[0])) * scale.end
    on_states = jnp.zeros_like(w.x)
    first = 1 - rule.first  # of the nodes, the first that follows the segment's start
    state = wide(state, size.n) * clock * scale.x[None, None]
    on_states = on_states.at[:, : size.nodes - first].set(state[:, first:])
    zeros = jax.tree_util.tree_map(jnp.zeros_like, w)
    net = zeros._replace(
        x=on_states, u=wide(control, size.m) * clock * scale.u[None, None], path=path, end=end
    )
    return {"y": Rows(defect, path, end), "net": net}
