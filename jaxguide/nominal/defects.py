"""How far an extremal's polynomials miss its dynamics between the nodes."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import largest_bound, positive, size_along
from jaxguide.conditions.bounded import oversteps_between
from jaxguide.conditions.sizes import state_sizes
from jaxguide.spectral import (
    differentiation_matrix,
    interpolation_matrix,
    legendre_matrix,
    nodes_lg,
)
from jaxguide.trajectory import Extremal

_ROUNDING = 1e-9  # a weight below it is that of a point which is no node of the quadrature
# Share of the running cost with every state and control moved by its size, of which errors are
# resolved at least: where the cost vanishes along the trajectory nothing else says how large it is.
# Chosen, not tuned.
_LEAST_COST = 1e-3


def defects(
    extremal: Extremal, tau: Float[Array, " point"], within: tuple[Array, Array] | None = None
) -> Float[Array, "segment point n"]:
    """dx/dt - f at the points `tau` of [-1, 1] in every segment, states per time.

    `within`: bounds that the interpolated control is cut to, (m,) each; none: flown as it is.
    """
    problem, breaks, nodes = extremal.problem, extremal.breaks, extremal.reference_nodes
    half = jnp.diff(breaks) / 2
    times = (breaks[1:] + breaks[:-1])[:, None] / 2 + half[:, None] * tau[None]
    between = interpolation_matrix(nodes, tau)
    at = lambda matrix, values: jnp.einsum("gp,spk->sgk", matrix, values)
    states = extremal.by_segment(extremal.x)
    x, u = at(between, states), at(between, extremal.control_by_segment())
    if within is not None:
        u = jnp.clip(u, within[0][None, None], within[1][None, None])
    rate = at(between @ differentiation_matrix(nodes), states)
    rate = rate / jnp.where(half > 0, half, 1.0)[:, None, None]
    return rate - jax.vmap(jax.vmap(problem.dynamics))(times, x, u)


@eqx.filter_jit
def segment_errors(extremal: Extremal) -> Float[Array, " segment"]:
    """By segment, the largest of what its polynomials miss between the nodes, each relative to its
    size:

    - the integral of |dx/dt - f|, of each state;
    - the running cost's integral against the quadrature by the nodes, relative to the whole
      integral of |F|;
    - by how much states and path constraints overstep their bounds.
    """
    problem, nodes = extremal.problem, extremal.reference_nodes
    gauss, weights = (jnp.asarray(a, extremal.t.dtype) for a in nodes_lg(2 * extremal.degree))
    half = jnp.diff(extremal.breaks) / 2
    span = state_sizes(problem, extremal.t, extremal.x, extremal.u)
    gap = half[:, None] * jnp.einsum("g,sgk->sk", weights, jnp.abs(defects(extremal, gauss)))
    parts = (
        extremal.by_segment(extremal.t[:, None])[..., 0],
        extremal.by_segment(extremal.x),
        extremal.control_by_segment(),
    )
    between = interpolation_matrix(nodes, gauss)
    t, x, u = (jnp.einsum("gp,sp...->sg...", between, a) for a in parts)
    at = (t, x, u)
    over = lambda f, points: jax.vmap(jax.vmap(f))(*points)
    cost = over(problem.running_cost, at)
    # Points that are no nodes of the quadrature have the weight zero.
    own = 2 * legendre_matrix(nodes)[0]
    known = jnp.where(jnp.abs(own)[None] > _ROUNDING, over(problem.running_cost, parts), 0.0) @ own
    missed = half * jnp.abs(cost @ weights - known)
    whole = jnp.sum(half * (jnp.abs(cost) @ weights))
    most = size_along(extremal.u, problem.control_bounds)
    away = (t, x + span[None, None], u + most[None, None])
    away = jnp.abs(over(problem.running_cost, away))
    least = _LEAST_COST * 2 * jnp.sum(half) * jnp.median(jnp.where(jnp.isfinite(away), away, 0.0))
    missed = missed / positive(jnp.maximum(whole, least))
    h = over(problem.path_constraints, at)
    sizes = (_path_sizes(h, problem.path_bounds), span)
    path, state = oversteps_between(problem, nodes_lg(2 * extremal.degree)[0], at, sizes)
    worst = lambda a: jnp.max(a, axis=(1, 2), initial=0.0)
    return jnp.max(
        jnp.stack([jnp.max(gap / span[None], axis=1), missed, worst(state), worst(path)]), axis=0
    )


def _path_sizes(h: Float[Array, "segment point p"], bounds: Any) -> Float[Array, " p"]:
    """The range of each path constraint along the trajectory, or its largest bound."""
    span = jnp.max(h, axis=(0, 1)) - jnp.min(h, axis=(0, 1))
    return positive(jnp.maximum(span, largest_bound(bounds, h.shape[2])))
