"""Shooting with coarse steps: a damped Newton iteration in fixed shapes and without LAPACK."""

import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.canonical import canonical_rates
from jaxguide.linalg import gauss_solve
from jaxguide.nominal.indirect.boundary import Unknowns, boundary_residual, horizon, unknown_sizes
from jaxguide.nominal.steps import rk4
from jaxguide.problem import Problem, is_free

# Residual, relative to what a change of every unknown by its size would do to it, below which the
# iteration ends, and below which it counts as converged: coarse steps are off by more than either.
_SETTLED, CONVERGED = 1e-9, 1e-7
# Residual, relative to the sizes at the start, that counts as `_SETTLED`: a costate that vanishes
# at the solution is pure rounding there, and relative to its own size never settles. Chosen, not
# tuned: some 500 roundings.
_ROUNDING = 1e-13
_RISE = 2.0  # a residual may rise by this factor: Newton often climbs before it falls
_SHORTER, _SHORTEST = 0.3, 1e-3  # of a refused step; where no step is left
_ITERATIONS = 60


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


def damped_newton(problem: Problem, z: Unknowns, steps: int) -> tuple[Unknowns, Array, Array]:
    """Newton on the coarse boundary conditions.

    **Returns:** the unknowns, their relative residual, and the objective.

    Each pass evaluates residual and Jacobian once, at a trial point; a trial that is worse is
    retried with a shorter step. One evaluation in the loop keeps the program small. What is worse
    is measured in the residual's sizes at the start: those of the trial itself would let it run to
    where the Jacobian is large.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(z)

    def residual(v: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        z = unravel(v)
        ends = coarse_ends(problem, z, steps)
        r = boundary_residual(problem, z, ends)
        size = jax.flatten_util.ravel_pytree(unknown_sizes(problem, z, ends))[0]
        return r, (r, objective(problem, z, ends), size)

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
        v, dv, step, best, left, cost, unit, k = carry
        trial = clipped(v + step * dv)
        jacobian, (r, trial_cost, size) = jax.jacfwd(residual, has_aux=True)(trial)
        of = jnp.abs(jacobian) @ size
        of = jnp.where(of > 0, of, 1.0)
        unit = jnp.where(k == 0, of, unit)
        largest, relative = (jnp.max(jnp.abs(r) / by) for by in (unit, of))
        largest = jnp.where(jnp.isfinite(largest), largest, jnp.inf)
        better = largest < _RISE * best
        v = jnp.where(better, trial, v)
        dv = jnp.where(better, -gauss_solve(jacobian, r), dv)
        step = jnp.where(better, 1.0, _SHORTER * step)
        best = jnp.where(better, largest, best)
        reached = jnp.minimum(relative, largest * (_SETTLED / _ROUNDING))
        left = jnp.where(better, reached, left)
        return v, dv, step, best, left, jnp.where(better, trial_cost, cost), unit, k + 1

    one = jnp.ones((), flat.dtype)
    far, none = jnp.inf * one, jnp.zeros_like(flat)
    start = (flat, none, one, far, far, far, none, jnp.zeros((), jnp.int32))
    going = lambda c: (c[4] > _SETTLED) & (c[2] > _SHORTEST) & (c[7] < _ITERATIONS)
    v, _, _, _, left, cost, _, _ = jax.lax.while_loop(going, body, start)
    return unravel(v), left, cost


def objective(problem: Problem, z: Unknowns, ends: Float[Array, "arc two_n_1"]) -> Array:
    """E plus the integral of F, from the arcs' ends."""
    n = problem.n
    t0, tf = horizon(problem, z)
    return problem.endpoint_cost(z.starts[0, :n], ends[-1, :n], t0, tf) + jnp.sum(ends[:, 2 * n])
