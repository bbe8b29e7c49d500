"""The error of a direct solution between its nodes, as a smooth function of its mesh."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.spectral import differentiation_matrix, interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal


def mesh_error(extremal: Extremal) -> Float[Array, ""]:
    r"""Integral over the horizon of $|dx/dt - f(t, x, \bar u)|^2$, each state relative to its span.

    x and u are the polynomials of the solution, between its nodes too; $\bar u$ is u clipped to its
    bounds, as a vehicle would fly it. The error is zero only if dynamics and bounds hold
    everywhere: for a control that switches, if the mesh has breaks at the switches. It is smooth in
    the breaks except where a control touches its bound. It has local minima where a node instead of
    a break meets a switch; there are fewer of them with few nodes a segment.

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
