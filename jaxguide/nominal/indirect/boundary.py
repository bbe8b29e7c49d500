"""Shooting's unknowns, and what they must meet at the ends: 2002 paper eqs (3), (8), (9)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.conditions.canonical import optimal_hamiltonian
from jaxguide.conditions.hamiltonian import endpoint_lagrangian
from jaxguide.conditions.sizes import Sizes
from jaxguide.linalg import power_of_two
from jaxguide.problem import Problem, initial_values, initially_free, is_free


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


def unknown_sizes(problem: Problem, z: Unknowns, ends: Float[Array, "arc two_n_1"]) -> Unknowns:
    """How large each unknown is: states and costates by their largest value at the arcs' ends, nu
    by its largest entry, free times by the horizon; zero where they all vanish."""
    t0, tf = horizon(problem, z)
    both = jnp.abs(jnp.concatenate([z.starts, ends[:, : 2 * problem.n]]))
    largest = jnp.broadcast_to(jnp.max(both, axis=0), z.starts.shape)
    nu = jnp.broadcast_to(jnp.max(jnp.abs(z.nu), initial=0.0), z.nu.shape)
    span = jnp.abs(tf - t0)
    return Unknowns(largest, nu, jnp.full_like(z.t0, span), jnp.full_like(z.tf, span))


def unknown_units(problem: Problem, z: Unknowns) -> Unknowns:
    """Units of Newton's steps: the size of each unknown, as a power of two, by which nothing is
    rounded. The unit of a costate is at least the largest product of state and costate over the
    size of its own state: the costate of a state on which nothing depends is pure rounding, and no
    step makes that smaller."""
    size, n = unknown_sizes(problem, z, z.starts), problem.n
    x, costate = size.starts[:, :n], size.starts[:, n:]
    worth = jnp.max(x * costate)
    costate = jnp.maximum(costate, jnp.where(x > 0, worth / jnp.where(x > 0, x, 1.0), 0.0))
    size = size._replace(starts=jnp.concatenate([x, costate], axis=1))
    return jax.tree_util.tree_map(power_of_two, size)


def boundary_sizes(problem: Problem, arcs: int, size: Sizes) -> Float[Array, " condition"]:
    """How large each entry of `boundary_residual` may be: what its error is relative to."""
    of_state = jnp.concatenate([size.x, size.costate])
    free = jnp.asarray(initially_free(problem))
    start = jnp.where(free, size.costate, size.x)
    times = [t for t in (problem.final_time, problem.initial_time) if is_free(t)]
    energy = jnp.broadcast_to(size.hamiltonian, (len(times),))
    return jnp.concatenate([start, jnp.tile(of_state, arcs - 1), size.end, size.costate, energy])
