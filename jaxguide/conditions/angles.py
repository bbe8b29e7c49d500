"""Controls that are angles: jumps of 2 pi removed."""

import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.problem import Problem


def unwrap_angles(problem: Problem, t: Array, x: Array, u: Float[Array, "node m"]) -> Array:
    """Removes jumps of 2 pi from controls in which the Problem is periodic."""
    rates = jax.vmap(
        lambda t, x, u: jnp.append(problem.dynamics(t, x, u), problem.running_cost(t, x, u))
    )
    here, turn = rates(t, x, u), 2 * np.pi
    columns = []
    for j in range(problem.m):
        moved = lambda by, j=j: rates(t, x, u.at[:, j].add(by))
        there, aside = moved(turn), moved(turn / 4)
        size = jnp.max(jnp.maximum(jnp.abs(here), jnp.abs(there)), axis=0)[None]
        # Where a quarter turn is nothing either, the control is no angle.
        felt = jnp.any(jnp.abs(here - aside) > 1e-6 * size)
        periodic = felt & jnp.all(jnp.abs(here - there) <= 1e-9 * size)
        turns = jnp.round(jnp.diff(u[:, j]) / turn)
        total = jnp.concatenate([jnp.zeros(1, u.dtype), jnp.cumsum(turns)])
        columns.append(jnp.where(periodic, u[:, j] - turn * total, u[:, j]))
    return jnp.stack(columns, axis=1)
