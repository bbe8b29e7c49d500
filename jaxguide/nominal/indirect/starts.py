"""A start for shooting from a random flight: costates by least squares, none of them guessed."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.linalg import gauss_solve
from jaxguide.nominal.indirect.boundary import Unknowns
from jaxguide.nominal.starts import UNBOUNDED, bounds_middle, control_ends, drawn_final_time
from jaxguide.nominal.steps import rk4
from jaxguide.problem import (
    Problem,
    endpoint_count,
    initial_values,
    initially_free,
    is_free,
    start_value,
)

# Of a free initial component, half of 1 + its guess; of a free final time, a factor of 4 either way
# (log 4 = 1.4). First choices, which found the optima of the papers' problems.
_SCATTER, _SPREAD = 0.5, 1.4
_HORIZON = 1e-3  # units of time, where the guess of a free final time leaves no horizon at all
_RIDGE = 1e-8  # of the normal matrix's trace: keeps redundant constraints from exploding nu


def random_start(problem: Problem, key: Array, arcs: int, steps: int, dtype: Any) -> Unknowns:
    r"""A start from a random control: fly it, then choose $\nu$ so that H_u is smallest.

    The costate is affine in nu, so least squares over the flight gives it and with it the right
    scale of every multiplier: nothing about the costates is guessed.
    """
    times, xs, ends = _flown(problem, key, arcs * steps, dtype)
    lams, terminal = _adjoints(problem, times, xs, ends)
    rows = _stationarity(problem, times, xs, ends, lams, terminal)
    a, b = rows[:, 1:], rows[:, 0]
    normal, q = a.T @ a, a.shape[1]
    mean = jnp.trace(normal) / max(q, 1)
    ridge = _RIDGE * jnp.where(mean > 0, mean, 1.0)
    nu = -gauss_solve(normal + ridge * jnp.eye(q, dtype=dtype), a.T @ b)
    costate = lams[:, :, 0] + lams[:, :, 1:] @ nu
    starts = jnp.concatenate([xs, costate], axis=1)[: arcs * steps : steps]
    none = jnp.zeros((0,), dtype)
    return Unknowns(
        starts,
        nu,
        times[:1] if is_free(problem.initial_time) else none,
        times[-1:] if is_free(problem.final_time) else none,
    )


def _control(ends: Float[Array, "two m"], times: Array, t: Any) -> Float[Array, " m"]:
    """The straight line between `ends` at `t`."""
    return ends[0] + (ends[1] - ends[0]) * (t - times[0]) / (times[-1] - times[0])


def _flown(
    problem: Problem, key: Array, total: int, dtype: Any
) -> tuple[Float[Array, " instant"], Float[Array, "instant n"], Float[Array, "two m"]]:
    """Times and states of a flight with a random straight control, and that control's ends."""
    n, m = problem.n, problem.m
    k_u, k_t, k_x = jax.random.split(key, 3)
    draws = jax.random.uniform(k_u, (2, m), dtype, -1.0, 1.0)
    lo, hi = bounds_of(problem.control_bounds, m, dtype)
    ends = control_ends(problem, draws, bounds_middle(problem, dtype), UNBOUNDED)
    ends = jnp.clip(ends, lo[None], hi[None])
    x0, free = initial_values(problem, dtype), initially_free(problem)
    scatter = jax.random.normal(k_x, (n,), dtype) * (1 + jnp.abs(x0)) * _SCATTER
    x0 = jnp.where(jnp.asarray(free), x0 + scatter, x0)
    t0 = jnp.asarray(start_value(problem.initial_time), dtype)
    tf = jnp.asarray(start_value(problem.final_time), dtype)
    tf = jnp.maximum(tf, t0 + _HORIZON) if is_free(problem.final_time) else tf
    draw = jax.random.uniform(k_t, (), tf.dtype, -_SPREAD, _SPREAD)
    tf = drawn_final_time(problem, draw, t0, tf)
    times = t0 + (tf - t0) * jnp.linspace(0.0, 1.0, total + 1, dtype=dtype)
    rate = lambda t, x: problem.dynamics(t, x, _control(ends, times, t))
    return times, rk4(rate, x0, times), ends


def _adjoints(
    problem: Problem, times: Array, xs: Array, ends: Array
) -> tuple[Float[Array, "instant n columns"], Float[Array, "n columns"]]:
    """Costates along the flight, and at its end: column 0 for the costs, the others for each
    endpoint constraint (times its nu)."""
    t0, tf, x0, q = times[0], times[-1], xs[0], endpoint_count(problem)
    g_e = jax.grad(problem.endpoint_cost, argnums=1)(x0, xs[-1], t0, tf)
    j_e = jax.jacfwd(problem.endpoint_constraints, argnums=1)(x0, xs[-1], t0, tf)
    terminal = jnp.concatenate([g_e[:, None], j_e.T], axis=1)
    unit = jnp.zeros(1 + q, xs.dtype).at[0].set(1.0)

    def adjoint(carry: Array, node: tuple) -> tuple[Array, Array]:
        t, x, h = node
        u = _control(ends, times, t)
        f_x = jax.jacfwd(problem.dynamics, argnums=1)(t, x, u)
        cost_x = jax.grad(problem.running_cost, argnums=1)(t, x, u)
        rate = lambda p: f_x.T @ p + cost_x[:, None] * unit[None, :]
        k1 = rate(carry)
        k2 = rate(carry + h / 2 * k1)
        new = carry + h * k2
        return new, new

    backward = (times[:-1][::-1], xs[:-1][::-1], jnp.diff(times)[::-1])
    _, lams = jax.lax.scan(adjoint, terminal, backward)
    return jnp.concatenate([lams[::-1], terminal[None]]), terminal


def _stationarity(
    problem: Problem, times: Array, xs: Array, ends: Array, lams: Array, terminal: Array
) -> Float[Array, "row columns"]:
    """H_u along the flight, linear in (1, nu), and H(tf) = -dEbar/dtf of a free final time."""
    t0, tf, x0, xf = times[0], times[-1], xs[0], xs[-1]
    unit = jnp.zeros(terminal.shape[1], xs.dtype).at[0].set(1.0)

    def h_u_rows(t: Array, x: Array, lam: Array) -> Array:
        u = _control(ends, times, t)
        f_u = jax.jacfwd(problem.dynamics, argnums=2)(t, x, u)
        cost_u = jax.grad(problem.running_cost, argnums=2)(t, x, u)
        return f_u.T @ lam + cost_u[:, None] * unit[None, :]

    rows = jax.vmap(h_u_rows)(times, xs, lams).reshape(-1, terminal.shape[1])
    if not is_free(problem.final_time):
        return rows
    # It sets the scale that a problem of least time has from nowhere else; weighted like all the
    # other rows together.
    u_f = _control(ends, times, tf)
    g_t = jax.grad(problem.endpoint_cost, argnums=3)(x0, xf, t0, tf)
    j_t = jax.jacfwd(problem.endpoint_constraints, argnums=3)(x0, xf, t0, tf)
    known = problem.running_cost(tf, xf, u_f) + g_t
    row = problem.dynamics(tf, xf, u_f) @ terminal + jnp.concatenate([known[None], j_t])
    return jnp.concatenate([rows, row[None] * jnp.sqrt(1.0 * rows.shape[0])])
