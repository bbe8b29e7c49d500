"""Jumps of 2 pi removed from controls that are angles, recognised by the Problem's periodicity."""

import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, added, on_numpy, xp
from jaxguide.problem import Problem
from jaxguide.problem.points import rates

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
    turn = 2 * np.pi
    turns = xp.round(xp.diff(u, axis=0) / turn)
    # Whether the controls jump at all is known on the host alone.
    jumping = [j for j in range(problem.m) if not on_numpy(turns) or np.any(turns[:, j] != 0)]
    if not jumping:
        return u

    def moved(u: Array) -> Array:
        f, cost, _ = rates(problem, t, x, u)
        return xp.concatenate([f, cost[:, None]], axis=1)

    here, columns = moved(u), list(xp.moveaxis(u, 1, 0))
    for j in jumping:
        there, aside = (moved(added(u, np.s_[:, j], by)) for by in (turn, turn / 4))
        size = xp.max(xp.maximum(xp.abs(here), xp.abs(there)), axis=0)[None]
        # Where a quarter turn changes nothing either, the control is no angle.
        felt = xp.any(xp.abs(here - aside) > _FELT * size)
        periodic = felt & xp.all(xp.abs(here - there) <= _SAME * size)
        total = xp.concatenate([xp.zeros_like(turns, shape=1), xp.cumsum(turns[:, j])])
        columns[j] = xp.where(periodic, u[:, j] - turn * total, u[:, j])
    return xp.stack(columns, axis=1)
