"""Shooting with coarse steps: a damped Newton iteration in fixed shapes and without LAPACK."""

import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.canonical import canonical_rates
from jaxguide.linalg import gauss_solve
from jaxguide.nominal.indirect.boundary import Unknowns, boundary_residual, horizon
from jaxguide.nominal.steps import rk4
from jaxguide.problem import Problem, is_free


def coarse_ends(problem: Problem, z: Unknowns, steps: int) -> Float[Array, "arc two_n_1"]:
    """Each arc's end by fixed Runge-Kutta steps: good enough to choose among starts."""
    arcs = z.starts.shape[0]
    t0, tf = horizon(problem, z)
    grid = jnp.linspace(0.0, 1.0, arcs * steps + 1, dtype=z.starts.dtype)
    times = t0 + (tf - t0) * grid
    index = jnp.arange(arcs)[:, None] * steps + jnp.arange(steps + 1)[None, :]
    y = jnp.concatenate([z.starts, jnp.zeros((arcs, 1), z.starts.dtype)], axis=1)
    flow = lambda y, ts: rk4(lambda t, y: canonical_rates(problem, t, y), y, ts)[-1]
    return jax.vmap(flow)(y, times[index])


def damped_newton(
    problem: Problem, z: Unknowns, steps: int, iterations: int
) -> tuple[Unknowns, Array, Array]:
    """Newton on the coarse boundary conditions: z, max|residual| and the endpoint cost + integral.

    Each pass evaluates residual and Jacobian once, at a trial point; a trial that is worse is
    retried with a shorter step. One evaluation in the loop keeps the program small.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(z)

    def residual(v: Array) -> tuple[Array, tuple[Array, Array]]:
        z = unravel(v)
        ends = coarse_ends(problem, z, steps)
        r = boundary_residual(problem, z, ends)
        return r, (r, objective(problem, z, ends))

    def clipped(v: Array) -> Array:
        z = unravel(v)
        keep = lambda t, spec: (
            jnp.clip(t, jnp.asarray(spec.lo, t.dtype), jnp.asarray(spec.hi, t.dtype))
            if is_free(spec)
            else t
        )
        z = z._replace(t0=keep(z.t0, problem.initial_time), tf=keep(z.tf, problem.final_time))
        return jax.flatten_util.ravel_pytree(z)[0]

    def body(carry: tuple) -> tuple:
        v, dv, step, best, cost, k = carry
        trial = clipped(v + step * dv)
        jacobian, (r, trial_cost) = jax.jacfwd(residual, has_aux=True)(trial)
        size = jnp.max(jnp.abs(r))
        size = jnp.where(jnp.isfinite(size), size, jnp.inf)
        # Accept even a slight rise: Newton often climbs before it falls.
        better = size < 2.0 * best
        v = jnp.where(better, trial, v)
        dv = jnp.where(better, -gauss_solve(jacobian, r), dv)
        step = jnp.where(better, 1.0, 0.3 * step)
        best = jnp.where(better, size, best)
        return v, dv, step, best, jnp.where(better, trial_cost, cost), k + 1

    one = jnp.ones((), flat.dtype)
    start = (
        flat,
        jnp.zeros_like(flat),
        one,
        jnp.inf * one,
        jnp.inf * one,
        jnp.zeros((), jnp.int32),
    )
    going = lambda c: (c[3] > 1e-9) & (c[2] > 1e-3) & (c[5] < iterations)
    v, _, _, norm, cost, _ = jax.lax.while_loop(going, body, start)
    return unravel(v), norm, cost


def objective(problem: Problem, z: Unknowns, ends: Float[Array, "arc two_n_1"]) -> Array:
    """E plus the integral of F, from the arcs' ends."""
    n = problem.n
    t0, tf = horizon(problem, z)
    return problem.endpoint_cost(z.starts[0, :n], ends[-1, :n], t0, tf) + jnp.sum(ends[:, 2 * n])
