"""How far an extremal's polynomials miss its dynamics between the nodes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.sizes import state_sizes
from jaxguide.host.compilation import kept_quickly
from jaxguide.spectral import differentiation_matrix, interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal


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


@kept_quickly
def segment_errors(extremal: Extremal) -> Float[Array, " segment"]:
    """By segment, the integral of |dx/dt - f| between the nodes, relative to the state's span."""
    gauss, weights = (jnp.asarray(a, extremal.t.dtype) for a in nodes_lg(2 * extremal.degree))
    half = jnp.diff(extremal.breaks) / 2
    span = state_sizes(extremal.problem, extremal.t, extremal.x, extremal.u)
    gap = half[:, None] * jnp.einsum("g,sgk->sk", weights, jnp.abs(defects(extremal, gauss)))
    return jnp.max(gap / span[None], axis=1)
