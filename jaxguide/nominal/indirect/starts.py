"""A start for shooting from a random flight: costates by least squares, none of them guessed."""

from typing import Any

import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.bounds import bounds_of
from jaxguide.linalg import gauss_solve
from jaxguide.nominal.indirect.boundary import Unknowns
from jaxguide.nominal.steps import rk4
from jaxguide.problem import (
    Problem,
    endpoint_count,
    initial_values,
    initially_free,
    is_free,
    start_value,
)


def random_start(problem: Problem, key: Array, arcs: int, steps: int, dtype: Any) -> Unknowns:
    r"""A start from a random control: fly it, then choose $\nu$ so that H_u is smallest.

    The costate is affine in nu, so least squares over the flight gives it and with it the right
    scale of every multiplier: nothing about the costates is guessed.
    """
    n, m, q = problem.n, problem.m, endpoint_count(problem)
    k_u, k_t, k_x = jax.random.split(key, 3)
    lo, hi = bounds_of(problem.control_bounds, m, dtype)
    finite = jnp.isfinite(lo) & jnp.isfinite(hi)
    r = jax.random.uniform(k_u, (2, m), dtype, -1.0, 1.0)
    middle = jnp.where(finite, (lo + hi) / 2, 0.0)
    half = jnp.where(finite, (hi - lo) / 2, 3.0)
    ends = jnp.clip(middle[None] + half[None] * r, lo[None], hi[None])

    x0, free = initial_values(problem, dtype), initially_free(problem)
    scatter = jax.random.normal(k_x, (n,), dtype) * (1 + jnp.abs(x0)) * 0.5
    x0 = jnp.where(jnp.asarray(free), x0 + scatter, x0)
    t0 = jnp.asarray(start_value(problem.initial_time), dtype)
    tf = jnp.asarray(start_value(problem.final_time), dtype)
    if is_free(problem.final_time):
        # Log-uniform within a factor of 4 of the guess, inside the bounds.
        factor = jnp.exp(jax.random.uniform(k_t, (), dtype, -1.4, 1.4))
        span = jnp.maximum(tf - t0, 1e-3)
        tf = jnp.clip(
            t0 + span * factor,
            jnp.asarray(problem.final_time.lo, dtype),
            jnp.asarray(problem.final_time.hi, dtype),
        )
    total = arcs * steps
    times = t0 + (tf - t0) * jnp.linspace(0.0, 1.0, total + 1, dtype=dtype)
    control = lambda t: ends[0] + (ends[1] - ends[0]) * (t - t0) / (tf - t0)
    xs = rk4(lambda t, x: problem.dynamics(t, x, control(t)), x0, times)

    # Adjoint matrix: column 0 carries the costs, columns 1.. the constraints (times nu).
    g_e = jax.grad(problem.endpoint_cost, argnums=1)(x0, xs[-1], t0, tf)
    j_e = jax.jacfwd(problem.endpoint_constraints, argnums=1)(x0, xs[-1], t0, tf)
    terminal = jnp.concatenate([g_e[:, None], j_e.T], axis=1)
    unit = jnp.zeros(1 + q, dtype).at[0].set(1.0)

    def adjoint(carry: Array, node: tuple) -> tuple[Array, Array]:
        t, x, h = node
        u = control(t)
        f_x = jax.jacfwd(problem.dynamics, argnums=1)(t, x, u)
        cost_x = jax.grad(problem.running_cost, argnums=1)(t, x, u)
        rate = lambda p: f_x.T @ p + cost_x[:, None] * unit[None, :]
        k1 = rate(carry)
        k2 = rate(carry + h / 2 * k1)
        new = carry + h * k2
        return new, new

    backward = (times[:-1][::-1], xs[:-1][::-1], jnp.diff(times)[::-1])
    _, lams = jax.lax.scan(adjoint, terminal, backward)
    lams = jnp.concatenate([lams[::-1], terminal[None]])

    def h_u_rows(t: Array, x: Array, lam: Array) -> Array:
        u = control(t)
        f_u = jax.jacfwd(problem.dynamics, argnums=2)(t, x, u)
        cost_u = jax.grad(problem.running_cost, argnums=2)(t, x, u)
        return f_u.T @ lam + cost_u[:, None] * unit[None, :]

    rows = jax.vmap(h_u_rows)(times, xs, lams).reshape(-1, 1 + q)
    if is_free(problem.final_time):
        # H(tf) = -dEbar/dtf sets the scale that a pure minimum-time problem has from nowhere else;
        # weighted like all the others together.
        u_f = control(tf)
        g_t = jax.grad(problem.endpoint_cost, argnums=3)(x0, xs[-1], t0, tf)
        j_t = jax.jacfwd(problem.endpoint_constraints, argnums=3)(x0, xs[-1], t0, tf)
        known = problem.running_cost(tf, xs[-1], u_f) + g_t
        row = problem.dynamics(tf, xs[-1], u_f) @ terminal
        row = row + jnp.concatenate([known[None], j_t])
        rows = jnp.concatenate([rows, row[None] * jnp.sqrt(1.0 * rows.shape[0])])
    a, b = rows[:, 1:], rows[:, 0]
    normal = a.T @ a
    ridge = 1e-8 * (jnp.trace(normal) / max(q, 1) + 1e-30)
    nu = -gauss_solve(normal + ridge * jnp.eye(q, dtype=dtype), a.T @ b)
    costate = lams[:, :, 0] + lams[:, :, 1:] @ nu
    starts = jnp.concatenate([xs, costate], axis=1)[:total:steps]
    none = jnp.zeros((0,), dtype)
    return Unknowns(
        starts,
        nu,
        t0[None] if is_free(problem.initial_time) else none,
        tf[None] if is_free(problem.final_time) else none,
    )
