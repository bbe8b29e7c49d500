"""Bounds along a trajectory: how far it oversteps them, and whether their covectors fit.

**Source:** review, eq. (3) and the complementarity conditions after it.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.bounds import overstep, slackness
from jaxguide.conditions.sizes import Sizes
from jaxguide.problem import Problem
from jaxguide.problem.points import rates
from jaxguide.spectral import extremes_near


class BoundErrors(NamedTuple):
    """Errors at each node: oversteps of path constraints, states and controls, relative to their
    sizes; complementarity of all three, side by side in that order, relative to the Hamiltonian."""

    path: Float[Array, "node p"]
    state: Float[Array, "node n"]
    control: Float[Array, "node m"]
    complementarity: Float[Array, "node p_n_m"]


def oversteps(
    problem: Problem,
    t: Float[Array, " node"],
    x: Float[Array, "node n"],
    u: Float[Array, "node m"],
    size: Sizes,
) -> tuple[Float[Array, "node p"], Float[Array, "node n"], Float[Array, "node m"]]:
    """By how much path constraints, states and controls overstep their bounds, relative to their
    sizes."""
    path, state, control = (_over(*kind) for kind in _kinds(problem, t, x, u, size))
    return path, state, control


def oversteps_between(
    problem: Problem,
    points: np.ndarray,
    at: tuple[Float[Array, "segment point p"], Float[Array, "segment point n"]],
    size: tuple[Array, Array],
) -> tuple[Float[Array, "segment point p"], Float[Array, "segment point n"]]:
    """By how much path constraints and states overstep their bounds near `points` of each segment,
    the extremes between them included, relative to their sizes. `at`: path constraints and states
    there, segment by segment; `size`: of both."""
    bounds = (problem.path_bounds, problem.state_bounds)
    path, state = (
        xp.maximum(*(overstep(side, within) for side in extremes_near(points, values)))
        / of[None, None]
        for values, within, of in zip(at, bounds, size, strict=True)
    )
    return path, state


def _over(values: Float[Array, "node k"], bounds: Any, size: Array) -> Float[Array, "node k"]:
    return overstep(values, bounds) / size[None]


def _kinds(problem: Problem, t: Array, x: Array, u: Array, size: Sizes) -> Any:
    """Values, bounds and sizes of path constraints, of states and of controls."""
    h = rates(problem, t, x, u)[2]
    return (
        (h, problem.path_bounds, size.path),
        (x, problem.state_bounds, size.x),
        (u, problem.control_bounds, size.u),
    )


def bound_errors(
    problem: Problem,
    t: Float[Array, " node"],
    x: Float[Array, "node n"],
    u: Float[Array, "node m"],
    multipliers: tuple[Array, Array, Array],
    size: Sizes,
) -> BoundErrors:
    """`multipliers`: of path constraints, states and controls, (node, k) each."""
    kinds = _kinds(problem, t, x, u, size)
    path, state, control = (_over(*kind) for kind in kinds)
    signs = [
        slackness(by, values, within, of) * of[None]
        for by, (values, within, of) in zip(multipliers, kinds, strict=True)
    ]
    return BoundErrors(path, state, control, xp.concatenate(signs, axis=1) / size.hamiltonian)
