"""How far an extremal's polynomials miss its dynamics between the nodes."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.sizes import state_sizes
from jaxguide.spectral import differentiation_matrix, interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal


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
    span = state_sizes(problem, extremal.t, extremal.x, extremal.u)
    gap = half[:, None] * jnp.einsum("g,sgk->sk", weights, jnp.abs(rate - f))
    return jnp.max(gap / span[None], axis=1)
