"""The control that minimises the Hamiltonian at a point: in closed form, or by Newton's method on
H_u = 0 (2002 paper, eq. (7))."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.hamiltonian import hamiltonian
from jaxguide.linalg import cholesky_positive, gauss_solve
from jaxguide.problem import Problem, start_control

# Newton's iteration ends where a step is `_ROUNDING` eps long, or after `_MAX_STEPS`: near the
# solution the correct digits double with each step, so that most of the 40 are left for the damped
# steps before; a vmapped loop runs to its slowest lane, so that there must be a limit.
_ROUNDING, _MAX_STEPS = 4, 40
# Step lengths tried, all at once: H has few unknowns, so that six values of it cost less than a
# search of one after the other. Chosen, not tuned.
_STEPS = (1.0, 0.5, 0.25, 0.1, 0.03, 0.003)
# A full step below this part of the control's size is taken whatever H says: near the solution H
# changes by the square of the step, 1e-8 and less, and rounding soon hides that. Chosen, not tuned.
_SURE = 1e-4


@jax.jit
def minimising_control(
    problem: Problem, t: Any, x: Float[Array, " n"], costate: Float[Array, " n"]
) -> Float[Array, " m"]:
    """The control with H_u = 0 and H minimised: 2002 paper, eq. (7).

    The Problem's closed form if it offers one. Otherwise a damped Newton iteration that only
    descends in H, from the middle of the control bounds. Differentiated implicitly, to any order.

    **Error:** H_u to rounding where H_uu is regular. Where H_uu is singular or indefinite, the
    control at which the descent stopped; callers check Legendre-Clebsch (`Certificate`).
    """
    if problem.has_closed_form:
        return jnp.asarray(problem.optimal_control(t, x, costate), x.dtype)
    return newton_control(problem, t, x, costate, start_control(problem, x.dtype))


def newton_control(
    problem: Problem, t: Any, x: Array, costate: Array, guess: Array
) -> Float[Array, " m"]:
    """Descending Newton iteration on H_u = 0 from `guess`, with implicit derivatives.

    Steps are measured against 1 + |u| in the control's own unit, as nothing at a single point tells
    how large its controls are: bounds may be loose by any factor, and without bounds the search
    begins 0.1 from zero (`start_control`) in any units. The last step is at most 1e-15 long and its
    error of second order in that, so that controls far smaller than 1 are found too where H_u is
    close to linear around them.
    """

    def h(u: Array) -> Array:
        return hamiltonian(problem, t, x, u, costate)

    gradient = jax.grad(h)
    eye = jnp.eye(guess.shape[0], dtype=guess.dtype)
    eps = jnp.finfo(guess.dtype).eps

    def direction(u: Array) -> tuple[Array, Array]:
        g, h_uu = gradient(u), jax.jacfwd(gradient)(u)
        # Where H_uu is not positive definite, it is shifted by Gershgorin's bound on its lowest
        # eigenvalue; a tenth of its size more keeps the step finite (chosen, not tuned).
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
        # A full step that halves H_u and does not raise H is taken (the half is chosen, not tuned).
        settled = jnp.max(jnp.abs(gradient(full))) <= 0.5 * jnp.max(jnp.abs(g))
        small = jnp.max(jnp.abs(step)) <= _SURE * (1 + jnp.max(jnp.abs(u)))
        new = jnp.where((settled & (values[0] <= h(u))) | small, full, best)
        return new, jnp.max(jnp.abs(step)) / (1 + jnp.max(jnp.abs(u))), k + 1

    def search(_: Any, u0: Array) -> Array:
        start = (u0, jnp.full((), jnp.inf, u0.dtype), jnp.zeros((), jnp.int32))
        going = lambda c: (c[1] > _ROUNDING * eps) & (c[2] < _MAX_STEPS)
        return jax.lax.while_loop(going, body, start)[0]

    def tangent_solve(g: Any, y: Array) -> Array:
        return gauss_solve(jax.jacfwd(g)(jnp.zeros_like(y)), y)

    return jax.lax.custom_root(gradient, guess, search, tangent_solve)


# Shares of the control's size. `_FREE`: the forces of the last barrier, 1e-9 and less, would move
# the control by less than this where no constraint is active. `_NEAR`: the longest Newton step,
# beyond an interpolation's error and short of another branch of H_u = 0. Chosen, not tuned.
_FREE, _NEAR = 1e-7, 1e-3


@jax.jit
def polish_control(
    problem: Problem,
    t: Any,
    x: Array,
    u: Array,
    costate: Array,
    integral: Array,
    force: Array,
    size: Float[Array, " m"],
) -> Float[Array, " m"]:
    """One Newton step on H_u = 0 from `u`, an interpolated control near the solution.

    `u` itself is returned where that step is longer than `_NEAR` of the control's `size`, and where
    the `force` that constraints exert on the control (the bounds on |their share of H_u|) would
    move it by more than `_FREE` of it.

    **Arguments:** `integral` (r,): multipliers of the integral constraints, whose integrands are
    then part of H. `force` (m,), in units of H_u. `size` (m,): how large the controls are along the
    extremal (`bounds.size_along`), in their own units.
    """

    def stated(u: Array) -> Array:
        h = hamiltonian(problem, t, x, u, costate)
        return h + jnp.dot(integral, problem.integrands(t, x, u)) if len(integral) else h

    gradient = jax.grad(stated)
    h_u, h_uu = gradient(u), jax.jacfwd(gradient)(u)
    # Double where: a singular H_uu must not leak NaN into derivatives of the branch not taken.
    change = jnp.max(jnp.abs(h_uu) * size[None, :], axis=1)  # of H_u when u changes by its size
    regular = jnp.any(change > 0) & jnp.all(force <= _FREE * change)
    safe = jnp.where(regular, h_uu, jnp.eye(u.shape[0], dtype=u.dtype))
    step = gauss_solve(safe, h_u)
    small = regular & jnp.all(jnp.abs(step) <= _NEAR * size)
    return jnp.where(small, u - jnp.where(small, step, 0.0), u)
