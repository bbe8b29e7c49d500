"""Jumps of 2 pi removed from controls that are angles, recognised by the Problem's periodicity."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.problem import Problem

# Relative to the largest rate along the nodes: the least change by a quarter turn, and the largest
# by a whole turn, of which rounding of sine and cosine leaves 1e-15. Chosen, not tuned.
_FELT, _SAME = 1e-6, 1e-9


def unwrap_angles(
    problem: Problem,
    t: Float[Array, " node"],
    x: Float[Array, "node n"],
    u: Float[Array, "node m"],
) -> Float[Array, "node m"]:
    """`u` without jumps of 2 pi, in those controls (radians) in which dynamics and running cost
    have that period at every node; the others as they are."""
    rates = jax.vmap(
        lambda t, x, u: jnp.append(problem.dynamics(t, x, u), problem.running_cost(t, x, u))
    )
    here, turn = rates(t, x, u), 2 * np.pi
    columns = []
    for j in range(problem.m):
        moved = lambda by, j=j: rates(t, x, u.at[:, j].add(by))
        there, aside = moved(turn), moved(turn / 4)
        size = jnp.max(jnp.maximum(jnp.abs(here), jnp.abs(there)), axis=0)[None]
        # Where a quarter turn changes nothing either, the control is no angle.
        felt = jnp.any(jnp.abs(here - aside) > _FELT * size)
        periodic = felt & jnp.all(jnp.abs(here - there) <= _SAME * size)
        turns = jnp.round(jnp.diff(u[:, j]) / turn)
        total = jnp.concatenate([jnp.zeros(1, u.dtype), jnp.cumsum(turns)])
        columns.append(jnp.where(periodic, u[:, j] - turn * total, u[:, j]))
    return jnp.stack(columns, axis=1) if columns else u
