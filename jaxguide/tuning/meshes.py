"""How wrong a direct solution is between its nodes, as a smooth function of its mesh."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.spectral import differentiation_matrix, interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal


def mesh_error(extremal: Extremal) -> Float[Array, ""]:
    """Integral over the horizon of |dx/dt - f|^2, relative to the state's span, between the nodes,
    the control being cut to its bounds: no vehicle flies what its polynomial does beyond them.

    Zero only where dynamics and bounds hold everywhere: with controls that switch, on a mesh that
    has breaks at the switches. Smooth in the breaks but where a control touches its bound; there
    are local minima where nodes, not breaks, meet a switch: fewer of them on few nodes a segment.

    **Error:** quadrature exact for polynomials of twice the degree.
    """
    problem, breaks, nodes = extremal.problem, extremal.breaks, extremal.reference_nodes
    gauss, weights = (jnp.asarray(a, breaks.dtype) for a in nodes_lg(4 * nodes.shape[0]))
    half = jnp.diff(breaks) / 2
    times = (breaks[1:] + breaks[:-1])[:, None] / 2 + half[:, None] * gauss[None]
    to_gauss = interpolation_matrix(nodes, gauss)
    between = lambda matrix, v: jnp.einsum("gp,spk->sgk", matrix, v)
    x = between(to_gauss, extremal.by_segment(extremal.x))
    u = between(to_gauss, extremal.control_by_segment())
    lo, hi = bounds_of(problem.control_bounds, problem.m, u.dtype)
    u = jnp.clip(u, lo[None, None], hi[None, None])
    slope = to_gauss @ differentiation_matrix(nodes)
    rate = between(slope, extremal.by_segment(extremal.x)) / half[:, None, None]
    f = jax.vmap(jax.vmap(problem.dynamics))(times, x, u)
    span = jnp.max(extremal.x, axis=0) - jnp.min(extremal.x, axis=0)
    off = (rate - f) / jnp.where(span > 0, span, 1.0)[None, None]
    return jnp.sum(half[:, None] * weights[None] * jnp.sum(off**2, axis=2))
