"""How large each quantity of an extremal is, in its own unit: errors are relative to this."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import largest_bound, positive, size_along
from jaxguide.conditions.units import natural_units
from jaxguide.problem import Problem

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
    x_size = state_sizes(problem, t, x, u)
    z = jnp.concatenate([x_size, u_size])
    along = lambda f: jax.vmap(jax.jacfwd(_joined(f, problem.n), argnums=1))(t, _stack(x, u))
    path = jnp.max(_known(along(problem.path_constraints)) @ z, axis=0, initial=0.0)
    path = jnp.maximum(path, largest_bound(problem.path_bounds, path.shape[0]))

    end = end_sizes(problem, t, x, x_size)
    worth = jnp.max(jnp.max(jnp.abs(costate), axis=0) * x_size)
    e_x = jax.grad(problem.endpoint_cost, argnums=1)(x[0], x[-1], t[0], t[-1])
    cost = positive(worth + jnp.max(jnp.abs(e_x) * x_size))

    f = jax.vmap(problem.dynamics)(t, x, u)
    F = jax.vmap(problem.running_cost)(t, x, u)
    gain = jax.vmap(problem.integrands)(t, x, u) @ integral
    H = F + gain + jnp.sum(costate * f, axis=1)
    terms = jnp.abs(F) + jnp.sum(jnp.abs(costate * f), axis=1)
    hamiltonian = positive(jnp.max(jnp.abs(H)) + _TERMS * jnp.max(terms))
    return Sizes(x_size, u_size, horizon, cost, hamiltonian, positive(path), end)


def end_sizes(
    problem: Problem,
    t: Float[Array, " node"],
    x: Float[Array, "node n"],
    x_size: Float[Array, " n"],
) -> Float[Array, " q"]:
    """Sizes of the endpoint constraints: how much they change when states at both ends and times
    change by their sizes, or their largest bound."""
    e = lambda x0, xf, times: problem.endpoint_constraints(x0, xf, times[0], times[1])
    slopes = jax.jacfwd(e, argnums=(0, 1, 2))(x[0], x[-1], jnp.stack([t[0], t[-1]]))
    horizon = jnp.broadcast_to(t[-1] - t[0], (2,))
    end = _known(jnp.concatenate(slopes, axis=1)) @ jnp.concatenate([x_size, x_size, horizon])
    return positive(jnp.maximum(end, largest_bound(problem.endpoint_bounds, end.shape[0])))


def state_sizes(
    problem: Problem,
    t: Float[Array, " node"],
    x: Float[Array, "node n"],
    u: Float[Array, "node m"],
) -> Float[Array, " n"]:
    """Sizes of the states: see `sizes_of`. States and controls that are nothing but rounding count
    as large as their natural units where they move others."""
    span, most = jnp.max(jnp.abs(x), axis=0), jnp.max(jnp.abs(u), axis=0)
    times = jnp.stack([t[0], t[-1]])
    x_unit, u_unit = natural_units(problem, times, x[0], x[1:, None], u[1:, None])
    x_known = jnp.where(span > _NOISE * x_unit, span, x_unit)
    u_known = jnp.where(most > _NOISE * u_unit, most, u_unit)
    slopes = jax.vmap(jax.jacfwd(_joined(problem.dynamics, problem.n), argnums=1))(t, _stack(x, u))
    moved = _known(slopes) @ jnp.concatenate([x_known, u_known])
    # The median: at the end of an infinite horizon rates grow beyond all bounds.
    moved = (t[-1] - t[0]) * jnp.median(moved, axis=0)
    return positive(jnp.where(span >= _REST * moved, span, _MOVED * moved))


def _joined(f: Any, n: int) -> Any:
    return lambda t, z: f(t, z[:n], z[n:])


def _stack(x: Array, u: Array) -> Array:
    return jnp.concatenate([x, u], axis=1)


def _known(slopes: Array) -> Array:
    return jnp.where(jnp.isfinite(slopes), jnp.abs(slopes), 0.0)
