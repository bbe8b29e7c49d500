"""The Hamiltonian and the endpoint Lagrangian: 2002 paper, eqs (4), (5); review, H bar and
E bar."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.problem import Problem


@jax.jit
def hamiltonian(
    problem: Problem, t: Any, x: Float[Array, " n"], u: Float[Array, " m"], costate: Array
) -> Float[Array, ""]:
    """H = F + lambda^T f: 2002 paper, eq. (4), with the running cost added."""
    return problem.running_cost(t, x, u) + jnp.dot(costate, problem.dynamics(t, x, u))


def constrained_hamiltonian(
    problem: Problem, t: Array, x: Array, u: Array, costate: Array, held: Array
) -> Float[Array, ""]:
    """H plus the multipliers `held` times what they hold, stacked in this order: path constraints,
    states, controls, integrands. Review, H bar."""
    h, r = problem.path_constraints(t, x, u), problem.integrands(t, x, u)
    return hamiltonian(problem, t, x, u, costate) + jnp.dot(held, jnp.concatenate([h, x, u, r]))


def endpoint_lagrangian(
    problem: Problem, nu: Float[Array, " q"], x0: Any, xf: Any, t0: Any, tf: Any
) -> Float[Array, ""]:
    """Ebar = E + nu^T (e - target), 2002 paper, eq. (5); the target is the lower
    endpoint bound, equal to the upper one for an equation."""
    e = problem.endpoint_constraints(x0, xf, t0, tf)
    target = bounds_of(problem.endpoint_bounds, e.shape[0], e.dtype)[0]
    return problem.endpoint_cost(x0, xf, t0, tf) + jnp.dot(nu, e - target)
