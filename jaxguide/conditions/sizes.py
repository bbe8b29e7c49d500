"""How large each quantity of an extremal is, in its own unit: errors are relative to this."""

from typing import NamedTuple

from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.bounds import largest_bound, positive, size_along
from jaxguide.conditions.units import natural_units
from jaxguide.problem import Problem
from jaxguide.problem.points import EndSlopes, end_slopes, integrand_slopes, slopes

# A state is at rest if it stays below `_REST` of the distance by which its rate, with all terms of
# one sign, could move it over the horizon; its size is then `_MOVED` of that. By experiment.
_REST, _MOVED = 1e-6, 1e-3
# Share of its natural unit below which a state or control is what the optimiser's tolerance, 1e-9
# of such units, leaves of zero.
_NOISE = 1e-9
# Share of the largest terms of H that is added to its size: H may vanish because they cancel, and
# errors must be relative to something. Chosen, no experiment is recorded.
_TERMS = 1e-3


class Sizes(NamedTuple):
    """In user units, all above zero."""

    x: Float[Array, " n"]
    u: Float[Array, " m"]
    t: Float[Array, ""]  # the horizon
    cost: Float[Array, ""]  # the largest costate times the size of its state, or endpoint cost
    hamiltonian: Float[Array, ""]
    path: Float[Array, " p"]
    end: Float[Array, " q"]

    @property
    def costate(self) -> Float[Array, " n"]:
        """Change of the cost per change of a state by its size, over that size."""
        return self.cost / self.x


def sizes_of(
    problem: Problem,
    t: Float[Array, " node"],
    x: Float[Array, "node n"],
    u: Float[Array, "node m"],
    costate: Float[Array, "node n"],
    integral: Float[Array, " r"],
) -> Sizes:
    """Sizes along a trajectory with its costates.

    Of a state: its largest value, or if it is at rest the distance by which the others could move
    it. Of a control: its largest value, or its largest bound if it is zero. Of a constraint: how
    much it changes when every state and control changes by its size, or its largest bound.

    `integral`: the multipliers of the integral constraints.
    """
    horizon = t[-1] - t[0]
    u_size = size_along(u, problem.control_bounds)
    at = slopes(problem, t, x, u)
    x_size = _state_sizes(problem, at.f_by, t, x, u)
    z = xp.concatenate([x_size, u_size])
    path = xp.max(_known(at.path_by[:, :, :-1]) @ z, axis=0, initial=0.0)
    path = xp.maximum(path, largest_bound(problem.path_bounds, path.shape[0]))

    ends = end_slopes(problem, x[0], x[-1], t[0], t[-1])
    end = _end_sizes(problem, ends, horizon, x_size)
    worth = xp.max(xp.max(xp.abs(costate), axis=0) * x_size)
    e_x = ends.by[0, problem.n + 2 :]
    cost = positive(worth + xp.max(xp.abs(e_x) * x_size))

    gain = integrand_slopes(problem, t, x, u)[0] @ integral
    moved = costate * at.f
    H = at.cost + gain + xp.sum(moved, axis=1)
    terms = xp.abs(at.cost) + xp.sum(xp.abs(moved), axis=1)
    hamiltonian = positive(xp.max(xp.abs(H)) + _TERMS * xp.max(terms))
    return Sizes(x_size, u_size, horizon, cost, hamiltonian, positive(path), end)


def _end_sizes(
    problem: Problem, ends: EndSlopes, horizon: Float[Array, ""], x_size: Float[Array, " n"]
) -> Float[Array, " q"]:
    """Sizes of the endpoint constraints: how much they change when states at both ends and times
    change by their sizes, or their largest bound."""
    size = xp.concatenate([x_size, xp.broadcast_to(horizon, (2,)), x_size])
    end = _known(ends.by[1:]) @ size
    return positive(xp.maximum(end, largest_bound(problem.endpoint_bounds, end.shape[0])))


def state_sizes(
    problem: Problem,
    t: Float[Array, " node"],
    x: Float[Array, "node n"],
    u: Float[Array, "node m"],
) -> Float[Array, " n"]:
    """Sizes of the states: see `sizes_of`. States and controls that are nothing but rounding count
    as large as their natural units where they move others."""
    return _state_sizes(problem, slopes(problem, t, x, u).f_by, t, x, u)


def _state_sizes(problem: Problem, f_by: Array, t: Array, x: Array, u: Array) -> Float[Array, " n"]:
    span, most = xp.max(xp.abs(x), axis=0), xp.max(xp.abs(u), axis=0)
    times = xp.stack([t[0], t[-1]])
    x_unit, u_unit = natural_units(problem, times, x[0], x[1:, None], u[1:, None])
    x_known = xp.where(span > _NOISE * x_unit, span, x_unit)
    u_known = xp.where(most > _NOISE * u_unit, most, u_unit)
    moved = _known(f_by[:, :, :-1]) @ xp.concatenate([x_known, u_known])
    # The median: at the end of an infinite horizon rates grow beyond all bounds.
    moved = (t[-1] - t[0]) * xp.median(moved, axis=0)
    return positive(xp.where(span >= _REST * moved, span, _MOVED * moved))


def _known(slopes: Array) -> Array:
    return xp.where(xp.isfinite(slopes), xp.abs(slopes), 0.0)
