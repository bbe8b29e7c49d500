"""Moving and refining a mesh until its segments carry small and equal errors. Host only."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.nominal.pseudospectral import Pseudospectral
from jaxguide.problem import Problem
from jaxguide.spectral import differentiation_matrix, interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS

# How strongly breaks follow the error, and the share that smooth segments keep of the worst one's:
# first choices, tried on five problems of the library and not tuned.
_POWER, _FLOOR = 1 / 3, 0.03
_MOVES = 2  # of the mesh before it is doubled


@eqx.filter_jit
def segment_errors(extremal: Extremal) -> Float[Array, " segment"]:
    """By segment, the integral of |dx/dt - f| between the nodes, relative to the state's span."""
    problem, breaks = extremal.problem, extremal.breaks
    gauss, weights = (jnp.asarray(a, breaks.dtype) for a in nodes_lg(2 * extremal.degree))
    half = jnp.diff(breaks) / 2
    times = (breaks[1:] + breaks[:-1])[:, None] / 2 + half[:, None] * gauss[None]
    to_gauss = interpolation_matrix(extremal.reference_nodes, gauss)
    x = jnp.einsum("gp,spk->sgk", to_gauss, extremal.by_segment(extremal.x))
    u = jnp.einsum("gp,spk->sgk", to_gauss, extremal.control_by_segment())
    D = to_gauss @ differentiation_matrix(extremal.reference_nodes)
    rate = jnp.einsum("gp,spk->sgk", D, extremal.by_segment(extremal.x))
    rate = rate / jnp.where(half > 0, half, 1.0)[:, None, None]
    f = jax.vmap(jax.vmap(problem.dynamics))(times, x, u)
    span = 1e-3 + jnp.max(jnp.abs(extremal.x), axis=0)
    gap = half[:, None] * jnp.einsum("g,sgk->sk", weights, jnp.abs(rate - f))
    return jnp.max(gap / span[None], axis=1)


def moved(
    fractions: Float[np.ndarray, " edge"], errors: Float[np.ndarray, " segment"], segments: int
) -> Float[np.ndarray, " new_edge"]:
    """Breaks of `segments` segments that share the errors more equally."""
    share = np.maximum((errors / errors.max()) ** _POWER, _FLOOR)
    total = np.concatenate([[0.0], np.cumsum(share)])
    new = np.interp(np.linspace(0.0, total[-1], segments + 1), total, fractions)
    new[0], new[-1] = 0.0, 1.0
    return new


def refined(
    run: Callable[[Any, Problem, Any], Extremal],
    method: Pseudospectral,
    problem: Problem,
    extremal: Extremal,
) -> Extremal:
    """`extremal` again on better meshes, each from the last, until `mesh_tolerance` is met, the
    refinements are used up, or a solve fails (the last good one is then kept)."""
    for k in range(method.refinements):
        errors = np.asarray(segment_errors(extremal))
        good = bool(extremal.result == RESULTS.successful)
        if not good or not np.all(np.isfinite(errors)) or errors.max() <= method.mesh_tolerance:
            break
        breaks = np.asarray(extremal.breaks)
        fractions = (breaks - breaks[0]) / (breaks[-1] - breaks[0])
        segments = len(fractions) - 1
        if k % (_MOVES + 1) == _MOVES:
            segments *= 2
        where = lambda m: (m.fractions,)
        fractions = moved(fractions, errors, segments)
        method = eqx.tree_at(where, method, (fractions,), is_leaf=lambda v: v is None)
        better = run(method, problem, extremal)
        if not bool(better.result == RESULTS.successful):
            break
        extremal = better
    return extremal
