"""How far an extremal's polynomials miss its dynamics between the nodes."""

from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.conditions.sizes import state_sizes
from jaxguide.problem.points import rates
from jaxguide.spectral import nodes_lg
from jaxguide.spectral.either import differentiating, interpolating
from jaxguide.trajectory import Extremal


def defects(
    extremal: Extremal, tau: Float[Array, " point"], within: tuple[Array, Array] | None = None
) -> Float[Array, "segment point n"]:
    """dx/dt - f at the points `tau` of [-1, 1] in every segment, states per time.

    `within`: bounds that the interpolated control is cut to, (m,) each; none: flown as it is.
    """
    problem, breaks, nodes = extremal.stated, extremal.breaks, extremal.reference_nodes
    half = xp.diff(breaks) / 2
    times = (breaks[1:] + breaks[:-1])[:, None] / 2 + half[:, None] * tau[None]
    between, states = interpolating(nodes, tau), extremal.by_segment(extremal.x)
    x, u = between @ states, between @ extremal.control_by_segment()
    if within is not None:
        u = xp.clip(u, within[0][None, None], within[1][None, None])
    rate = (between @ differentiating(nodes)) @ states
    rate = rate / xp.where(half > 0, half, 1.0)[:, None, None]
    flat = lambda a: a.reshape(-1, a.shape[2])
    return rate - rates(problem, times.reshape(-1), flat(x), flat(u))[0].reshape(rate.shape)


def segment_errors(extremal: Extremal) -> Float[Array, " segment"]:
    """By segment, the integral of |dx/dt - f| between the nodes, relative to the state's span."""
    gauss, weights = (xp.asarray(a, extremal.t.dtype) for a in nodes_lg(2 * extremal.degree))
    half = xp.diff(extremal.breaks) / 2
    span = state_sizes(extremal.stated, extremal.t, extremal.x, extremal.u)
    off = xp.abs(defects(extremal, gauss))
    gap = half[:, None] * xp.einsum("g,sgk->sk", weights, off)
    return xp.max(gap / span[None], axis=1)
