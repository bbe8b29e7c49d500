"""The canonical equations with the control eliminated: 2002 paper, eqs (2), (6), (7)."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.control import minimising_control
from jaxguide.conditions.hamiltonian import hamiltonian
from jaxguide.problem import Problem


@jax.jit
def canonical_rates(
    problem: Problem, t: Any, y: Float[Array, " two_n_1"]
) -> Float[Array, " two_n_1"]:
    """d/dt of (x, lambda, cost), each per unit of time: 2002 paper, eqs (2), (6), with u from
    eq. (7)."""
    n = problem.n
    x, costate = y[:n], y[n : 2 * n]
    u = minimising_control(problem, t, x, costate)
    h_x = jax.grad(hamiltonian, argnums=2)(problem, t, x, u, costate)
    cost = problem.running_cost(t, x, u)
    return jnp.concatenate([problem.dynamics(t, x, u), -h_x, cost[None]])


def optimal_hamiltonian(problem: Problem, t: Any, y: Float[Array, " two_n_1"]) -> Float[Array, ""]:
    """H at the minimising control (2002 paper, eqs (4), (7)), for y = (x, lambda, cost)."""
    n = problem.n
    u = minimising_control(problem, t, y[:n], y[n : 2 * n])
    return hamiltonian(problem, t, y[:n], u, y[n : 2 * n])
