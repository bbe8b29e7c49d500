"""The trajectory of given parameters as an Extremal: costates by the adjoint of the flow."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.hamiltonian import endpoint_lagrangian, hamiltonian
from jaxguide.nominal.parametric import flow as par
from jaxguide.nominal.parametric.equality import derivatives
from jaxguide.nominal.steps import dopri8
from jaxguide.problem import Problem
from jaxguide.spectral import nodes_lgl
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.types import RESULTS


def parametric_extremal(
    problem: Problem,
    positions: Any,
    a: Any,
    nu: Any,
    degree: int = 8,
    residual: Any = 0.0,
) -> Extremal:
    """The trajectory of given parameters, with the costates that belong to the multipliers `nu`
    (None: those that leave the least gradient), as an Extremal whose segments are the intervals."""
    positions = jnp.asarray(positions, jnp.result_type(float))
    a = jnp.asarray(a, positions.dtype)
    start = par.from_the_start(problem, positions.dtype)
    if nu is None:
        values = lambda a, _: par.outcome(problem, positions, a, start, degree)[:2]
        nu = derivatives(values, a, None).nu
    controls, tf = par.unpack(problem, a)
    t0 = jnp.asarray(problem.initial_time, positions.dtype)
    ys = par.fly(problem, positions, a, start, degree)
    points = jnp.asarray(nodes_lgl(degree + 1)[0], positions.dtype)
    joined = lambda v: jnp.concatenate([v[:, :-1].reshape(-1, *v.shape[2:]), v[-1, -1:]])
    tau = joined(positions[:-1, None] + jnp.diff(positions)[:, None] * (points[None] + 1) / 2)
    t, x = t0 + (tf - t0) * tau, joined(ys)[:, :-1]
    u = jax.vmap(lambda tau: par.control_at(positions, controls, tau))(tau)
    end = jax.grad(endpoint_lagrangian, argnums=3)(problem, nu, x[0], x[-1], t0, tf)
    costate = _costates(problem, positions, controls, t, x, end, points)
    zeros = lambda k: jnp.zeros((t.shape[0], k), t.dtype)
    return Extremal(
        t=t,
        x=x,
        u=u,
        reference_nodes=points,
        costate=costate,
        final_time=t[-1],
        objective=problem.endpoint_cost(x[0], x[-1], t0, tf) + ys[-1, -1, -1],
        multipliers=Multipliers(
            nu, zeros(0), zeros(problem.n), zeros(problem.m), jnp.zeros(0, t.dtype)
        ),
        result=RESULTS.where(jnp.array(True), RESULTS.successful, RESULTS.successful),
        residual=jnp.asarray(residual, t.dtype),
        problem=problem,
        parametric=True,
    )


def _costates(
    problem: Problem,
    positions: Array,
    controls: Array,
    t: Array,
    x: Array,
    end: Float[Array, " n"],
    points: Array,
) -> Float[Array, "node n"]:
    """The adjoint of the flow, 2002 paper, eq. (6), backwards from its end, the state flown back
    beside it."""
    n, (t0, tf) = problem.n, (t[0], t[-1])

    def back(carry: Array, part: tuple) -> tuple[Array, Array]:
        t_a, t_b, left, right, x_b = part
        y = jnp.concatenate([x_b, carry[n:]])  # the state as flown: no drift over many intervals

        def rate(t: Array, y: Array) -> Array:
            u = left + (t - t_a) / (t_b - t_a) * (right - left)
            h_x = jax.grad(hamiltonian, argnums=2)(problem, t, y[:n], u, y[n:])
            return jnp.concatenate([problem.dynamics(t, y[:n], u), -h_x])

        ys = dopri8(rate, y, t_a + (t_b - t_a) * (points[::-1] + 1) / 2)
        return ys[-1], ys[::-1, n:]

    edges, step = t0 + (tf - t0) * positions, points.shape[0] - 1
    parts = (edges[:-1], edges[1:], controls[:-1], controls[1:], x[step::step])
    _, parts = jax.lax.scan(back, jnp.concatenate([x[-1], end]), parts, reverse=True)
    return jnp.concatenate([parts[:, :-1].reshape(-1, n), parts[-1, -1:]])
