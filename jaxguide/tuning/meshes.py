"""The error of a direct solution between its nodes, as a smooth function of its mesh."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.nominal.defects import defects
from jaxguide.spectral import nodes_lg
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
    problem, points = extremal.problem, 4 * extremal.reference_nodes.shape[0]
    gauss, weights = (jnp.asarray(a, extremal.t.dtype) for a in nodes_lg(points))
    half = jnp.diff(extremal.breaks) / 2
    within = bounds_of(problem.control_bounds, problem.m, extremal.u.dtype)
    span = jnp.max(extremal.x, axis=0) - jnp.min(extremal.x, axis=0)
    off = defects(extremal, gauss, within) / jnp.where(span > 0, span, 1.0)[None, None]
    return jnp.sum(half[:, None] * weights[None] * jnp.sum(off**2, axis=2))
