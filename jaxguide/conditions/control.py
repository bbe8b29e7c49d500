"""The control that minimises the Hamiltonian at a point: closed form, or Newton on H_u = 0."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.hamiltonian import hamiltonian
from jaxguide.linalg import cholesky_positive, gauss_solve
from jaxguide.problem import Problem, start_control

_MAX_STEPS = 40
_STEPS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.003)  # step lengths tried; H_u = 0 is low-dimensional


@jax.jit
def minimising_control(
    problem: Problem, t: Any, x: Float[Array, " n"], costate: Float[Array, " n"]
) -> Float[Array, " m"]:
    """The control with H_u = 0 and H minimised (paper eq. 7).

    A closed form is used where the Problem offers one; else a damped Newton iteration that only
    descends in H, from the middle of the control bounds. Differentiated implicitly, to any order.

    **Error:** H_u to rounding where H_uu is regular. For a singular or indefinite H_uu the result
    is where descent stopped; callers check Legendre-Clebsch (`Certificate`).
    """
    if problem.has_closed_form:
        return jnp.asarray(problem.optimal_control(t, x, costate), x.dtype)
    return newton_control(problem, t, x, costate, start_control(problem, x.dtype))


def newton_control(
    problem: Problem, t: Any, x: Array, costate: Array, guess: Array
) -> Float[Array, " m"]:
    """Descending Newton iteration on H_u = 0 from `guess`, with implicit derivatives."""

    def h(u: Array) -> Array:
        return hamiltonian(problem, t, x, u, costate)

    gradient = jax.grad(h)
    eye = jnp.eye(guess.shape[0], dtype=guess.dtype)
    eps = jnp.finfo(guess.dtype).eps

    def direction(u: Array) -> tuple[Array, Array]:
        g, h_uu = gradient(u), jax.jacfwd(gradient)(u)
        # Where H_uu is not positive definite, Gershgorin's bound shifts it until it is.
        radius = jnp.sum(jnp.abs(h_uu), axis=1) - jnp.abs(jnp.diag(h_uu))
        lowest = jnp.min(jnp.diag(h_uu) - radius)
        size = jnp.max(jnp.abs(h_uu)) + jnp.finfo(u.dtype).tiny
        shift = jnp.where(cholesky_positive(h_uu), 0.0, jnp.maximum(0.1 * size - lowest, 0.0))
        return g, -gauss_solve(h_uu + shift * eye, g)

    def body(carry: tuple) -> tuple:
        u, _, k = carry
        g, step = direction(u)
        trials = u[None, :] + jnp.asarray(_STEPS, u.dtype)[:, None] * step[None, :]
        values = jax.vmap(h)(trials)
        best = trials[jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))]
        full = trials[0]
        settled = jnp.max(jnp.abs(gradient(full))) <= 0.5 * jnp.max(jnp.abs(g))
        small = jnp.max(jnp.abs(step)) <= 1e-4 * (1 + jnp.max(jnp.abs(u)))
        new = jnp.where((settled & (values[0] <= h(u))) | small, full, best)
        return new, jnp.max(jnp.abs(step)) / (1 + jnp.max(jnp.abs(u))), k + 1

    def search(_: Any, u0: Array) -> Array:
        start = (u0, jnp.full((), jnp.inf, u0.dtype), jnp.zeros((), jnp.int32))
        going = lambda c: (c[1] > 4 * eps) & (c[2] < _MAX_STEPS)
        return jax.lax.while_loop(going, body, start)[0]

    def tangent_solve(g: Any, y: Array) -> Array:
        return gauss_solve(jax.jacfwd(g)(jnp.zeros_like(y)), y)

    return jax.lax.custom_root(gradient, guess, search, tangent_solve)


_FREE = 1e-7  # relative to the control's size: what a barrier's inactive bounds stay below


@jax.jit
def polish_control(
    problem: Problem, t: Any, x: Array, u: Array, costate: Array, integral: Array, force: Array
) -> Float[Array, " m"]:
    """One Newton step on H_u = 0 from a nearby `u`; `u` itself where that step is not small, or
    where the `force` of constraints on the control would move it by more than `_FREE`."""

    def stated(u: Array) -> Array:
        h = hamiltonian(problem, t, x, u, costate)
        return h + jnp.dot(integral, problem.integrands(t, x, u)) if len(integral) else h

    gradient = jax.grad(stated)
    h_u, h_uu = gradient(u), jax.jacfwd(gradient)(u)
    # Double where: a singular H_uu must not leak NaN into derivatives of the branch not taken.
    scale = jnp.max(jnp.abs(h_uu))
    regular = (scale > 0) & jnp.all(force <= _FREE * scale * (1 + jnp.abs(u)))
    safe = jnp.where(regular, h_uu, jnp.eye(u.shape[0], dtype=u.dtype))
    step = gauss_solve(safe, h_u)
    small = regular & jnp.all(jnp.abs(step) <= 1e-3 * (1 + jnp.abs(u)))
    return jnp.where(small, u - jnp.where(small, step, 0.0), u)
