"""The necessary conditions of the 2002 paper, eqs (5)-(10), by autodiff of the user's Problem."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.nominal.control import minimising_control
from jaxguide.problem import (
    Problem,
    bounds_of,
    hamiltonian,
    initial_values,
    initially_free,
    is_free,
)


class Unknowns(NamedTuple):
    """What shooting solves for: state and costate at the start of each arc, nu, free times."""

    starts: Float[Array, "arc two_n"]
    nu: Float[Array, " q"]
    t0: Float[Array, " chosen"]
    tf: Float[Array, " chosen"]


def horizon(problem: Problem, z: Unknowns) -> tuple[Array, Array]:
    """Initial and final time, chosen or given."""
    dtype = z.starts.dtype
    t0 = z.t0[0] if is_free(problem.initial_time) else jnp.asarray(problem.initial_time, dtype)
    tf = z.tf[0] if is_free(problem.final_time) else jnp.asarray(problem.final_time, dtype)
    return t0, tf


@jax.jit
def canonical_rates(problem: Problem, t: Any, y: Float[Array, " two_n_1"]) -> Array:
    """d/dt of (x, lambda, cost): eqs (2), (6), with u from eq. (7)."""
    n = problem.n
    x, costate = y[:n], y[n : 2 * n]
    u = minimising_control(problem, t, x, costate)
    h_x = jax.grad(hamiltonian, argnums=2)(problem, t, x, u, costate)
    cost = problem.running_cost(t, x, u)
    return jnp.concatenate([problem.dynamics(t, x, u), -h_x, cost[None]])


def endpoint_lagrangian(problem: Problem, nu: Array, x0: Any, xf: Any, t0: Any, tf: Any) -> Array:
    """Ebar = E + nu^T (e - target), eq. (5); the target is the (equal) endpoint bounds."""
    e = problem.endpoint_constraints(x0, xf, t0, tf)
    target = bounds_of(problem.endpoint_bounds, e.shape[0], e.dtype)[0]
    return problem.endpoint_cost(x0, xf, t0, tf) + jnp.dot(nu, e - target)


def optimal_hamiltonian(problem: Problem, t: Any, y: Array) -> Array:
    """H at the minimising control."""
    n = problem.n
    u = minimising_control(problem, t, y[:n], y[n : 2 * n])
    return hamiltonian(problem, t, y[:n], u, y[n : 2 * n])


def boundary_residual(problem: Problem, z: Unknowns, ends: Float[Array, "arc two_n_1"]) -> Array:
    """Everything that must vanish: initial state, continuity, eq. (3), transversality (8), (9).

    With H minimised, eq. (8) reads lambda(tf) = +dEbar/dx; a free initial component has
    lambda(t0) = -dEbar/dx0; a free final time H(tf) = -dEbar/dtf.
    """
    n = problem.n
    t0, tf = horizon(problem, z)
    x0, lam0 = z.starts[0, :n], z.starts[0, n:]
    xf, lamf = ends[-1, :n], ends[-1, n : 2 * n]
    given, free = initial_values(problem, z.starts.dtype), initially_free(problem)
    g_x0, g_xf, g_t0, g_tf = jax.grad(endpoint_lagrangian, argnums=(2, 3, 4, 5))(
        problem, z.nu, x0, xf, t0, tf
    )
    start = jnp.where(jnp.asarray(free), lam0 + g_x0, x0 - given)
    e = problem.endpoint_constraints(x0, xf, t0, tf)
    e = e - bounds_of(problem.endpoint_bounds, e.shape[0], e.dtype)[0]
    joined = (ends[:-1, : 2 * n] - z.starts[1:]).reshape(-1)
    parts = [start, joined, e, lamf - g_xf]
    if is_free(problem.final_time):
        parts.append((optimal_hamiltonian(problem, tf, ends[-1]) + g_tf)[None])
    if is_free(problem.initial_time):
        parts.append((optimal_hamiltonian(problem, t0, z.starts[0]) - g_t0)[None])
    return jnp.concatenate(parts)
