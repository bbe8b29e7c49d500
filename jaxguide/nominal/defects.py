"""How far an extremal's polynomials miss its dynamics between the nodes."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.bounds import largest_bound, positive, size_along
from jaxguide.conditions.bounded import oversteps_between
from jaxguide.conditions.sizes import state_sizes
from jaxguide.host.remembered import remembered
from jaxguide.problem import Problem
from jaxguide.problem.points import rates
from jaxguide.spectral import nodes_lg
from jaxguide.spectral.either import differentiating, interpolating, to_legendre
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
    times, x, u = _between(extremal, tau)
    if within is not None:
        u = xp.clip(u, within[0][None, None], within[1][None, None])
    flat = lambda a: a.reshape(a.shape[0] * a.shape[1], *a.shape[2:])
    f = rates(extremal.stated, *map(flat, (times, x, u)))[0]
    return _slopes_of_states(extremal, tau) - f.reshape(x.shape)


def _between(extremal: Extremal, tau: Float[Array, " point"]) -> tuple[Array, Array, Array]:
    """Times, states and controls at the points `tau` of every segment."""
    breaks, between = extremal.breaks, interpolating(extremal.reference_nodes, tau)
    half = xp.diff(breaks) / 2
    times = (breaks[1:] + breaks[:-1])[:, None] / 2 + half[:, None] * tau[None]
    states, controls = extremal.by_segment(extremal.x), extremal.control_by_segment()
    return times, between @ states, between @ controls


def _slopes_of_states(
    extremal: Extremal, tau: Float[Array, " point"]
) -> Float[Array, "segment point n"]:
    """dx/dt of the polynomials at the points `tau` of every segment."""
    nodes, half = extremal.reference_nodes, xp.diff(extremal.breaks) / 2
    slope = interpolating(nodes, tau) @ differentiating(nodes)
    rate = slope @ extremal.by_segment(extremal.x)
    return rate / xp.where(half > 0, half, 1.0)[:, None, None]


@remembered
def segment_errors(extremal: Extremal) -> Float[Array, " segment"]:
    """By segment, the largest of what its polynomials miss between the nodes, each relative to its
    size:

    - the integral of |dx/dt - f|, of each state;
    - the running cost's integral against the quadrature by the nodes, relative to the whole
      integral of |F|;
    - by how much states and path constraints overstep their bounds.
    """
    problem, nodes, degree = extremal.stated, extremal.reference_nodes, extremal.degree
    gauss, weights = (xp.asarray(a, extremal.t.dtype) for a in nodes_lg(2 * degree))
    half = xp.diff(extremal.breaks) / 2
    size = state_sizes(problem, extremal.t, extremal.x, extremal.u)
    t, x, u = _between(extremal, gauss)
    own = (extremal.by_segment(extremal.t[:, None])[..., 0], extremal.by_segment(extremal.x))
    own = (*own, extremal.control_by_segment())
    of_u = size_along(extremal.u, problem.control_bounds)
    away = (t, x + size[None, None], u + of_u[None, None])
    (f, cost, h), (_, known, _), (_, far, _) = _rates_at(problem, (t, x, u), own, away)
    gap = xp.abs(_slopes_of_states(extremal, gauss) - f)
    gap = half[:, None] * xp.einsum("g,sgk->sk", weights, gap) / size[None]

    # Points that are no nodes of the quadrature have the weight zero.
    share = 2 * to_legendre(nodes)[0]
    known = xp.where(xp.abs(share)[None] > _ROUNDING, known, 0.0) @ share
    missed = half * xp.abs(cost @ weights - known)
    whole = xp.sum(half * (xp.abs(cost) @ weights))
    far = xp.where(xp.isfinite(far), xp.abs(far), 0.0)
    least = _LEAST_COST * 2 * xp.sum(half) * xp.median(far)
    missed = missed / positive(xp.maximum(whole, least))

    sizes = (_path_sizes(h, problem.path_bounds), size)
    path, state = oversteps_between(problem, nodes_lg(2 * degree)[0], (h, x), sizes)
    worst = lambda a: xp.max(a, axis=(1, 2), initial=0.0)
    return xp.max(xp.stack([xp.max(gap, axis=1), missed, worst(state), worst(path)]), axis=0)


def _rates_at(problem: Problem, *points: tuple[Array, Array, Array]) -> list[list[Array]]:
    """`rates` at several kinds of points in every segment, by one evaluation of all."""
    flat = lambda a: a.reshape(a.shape[0] * a.shape[1], *a.shape[2:])
    all_points = [xp.concatenate([flat(a) for a in kind]) for kind in zip(*points, strict=True)]
    ends = np.cumsum([p[0].shape[0] * p[0].shape[1] for p in points])[:-1]
    parts = [xp.split(value, ends) for value in rates(problem, *all_points)]
    return [
        [part.reshape(*p[0].shape, *part.shape[1:]) for part in kind]
        for p, kind in zip(points, zip(*parts, strict=True), strict=True)
    ]


def _path_sizes(h: Float[Array, "segment point p"], bounds: Any) -> Float[Array, " p"]:
    """The range of each path constraint along the trajectory, or its largest bound."""
    span = xp.max(h, axis=(0, 1)) - xp.min(h, axis=(0, 1))
    return positive(xp.maximum(span, largest_bound(bounds, h.shape[2])))
