"""The necessary conditions solved to rounding on a fixed mesh, and what the result is worth."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import overstep
from jaxguide.conditions.angles import unwrap_angles
from jaxguide.conditions.bounded import oversteps
from jaxguide.conditions.canonical import canonical_rates
from jaxguide.conditions.control import minimising_control
from jaxguide.conditions.hamiltonian import hamiltonian
from jaxguide.conditions.sizes import Sizes
from jaxguide.linalg import cholesky_positive
from jaxguide.nominal.indirect.boundary import (
    Unknowns,
    boundary_residual,
    boundary_sizes,
    horizon,
    unknown_units,
)
from jaxguide.nominal.indirect.coarse import objective
from jaxguide.nominal.roots import differentiable_if, implicit_root
from jaxguide.nominal.steps import dopri8
from jaxguide.problem import Problem, count, is_free
from jaxguide.spectral import nodes_lgl
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.types import RESULTS

_STEP, _STEPS = 1e-12, 20  # the last relative step of Newton, and how many it may take
# Boundary conditions, relative to their sizes: Newton is quadratic, short of this it did not
# converge. Bounds likewise, which nothing here enforces.
_CONVERGED, _WITHIN = 1e-9, 1e-9


def shot(
    problem: Problem, z: Unknowns, breaks: Float[Array, " edge"], arcs: int, degree: int
) -> Extremal:
    """The extremal near `z` on segments with `breaks` (fractions of the horizon): one Dopri8 step
    between each two of the `degree + 1` LGL points of a segment. Derivatives are implicit."""
    tau = jnp.asarray(nodes_lgl(degree + 1)[0], z.starts.dtype)
    inner = breaks[:-1, None] + jnp.diff(breaks)[:, None] * (tau[None, :-1] + 1) / 2
    fractions = jnp.concatenate([inner.reshape(-1), breaks[-1:]])
    per_arc = (fractions.shape[0] - 1) // arcs
    index = jnp.arange(arcs)[:, None] * per_arc + jnp.arange(per_arc + 1)[None, :]

    def fly(z: Unknowns, problem: Problem) -> Float[Array, "arc point two_n_1"]:
        t0, tf = horizon(problem, z)
        times = t0 + (tf - t0) * fractions
        y = jnp.concatenate([z.starts, jnp.zeros((arcs, 1), z.starts.dtype)], axis=1)
        rate = lambda t, y: canonical_rates(problem, t, y)
        return jax.vmap(lambda y, ts: dopri8(rate, y, ts))(y, times[index])

    def residual(z: Unknowns, problem: Problem) -> Array:
        return boundary_residual(problem, z, fly(z, problem)[:, -1])

    z = implicit_root(residual, z, problem, _STEP, _STEPS, unknown_units(problem, z))
    return _extremal(problem, z, fractions, tau, fly(z, problem))


def _extremal(
    problem: Problem,
    z: Unknowns,
    fractions: Float[Array, " node"],
    tau: Float[Array, " p"],
    flown: Float[Array, "arc point two_n_1"],
) -> Extremal:
    """The arcs `flown` side by side, with their controls."""
    y = jnp.concatenate([flown[:, :-1].reshape(-1, flown.shape[2]), flown[-1, -1:]])
    t0, tf = horizon(problem, z)
    t, n = t0 + (tf - t0) * fractions, problem.n
    x, costate = y[:, :n], y[:, n : 2 * n]
    u = jax.vmap(lambda t, x, c: minimising_control(problem, t, x, c))(t, x, costate)
    u = unwrap_angles(problem, t, x, u)
    ends = flown[:, -1]
    zeros = lambda k: jnp.zeros((t.shape[0], k), t.dtype)
    path, none = zeros(count(problem, "path_constraints")), jnp.zeros(0, t.dtype)
    extremal = Extremal(
        t=t,
        x=x,
        u=u,
        reference_nodes=tau,
        costate=costate,
        final_time=tf,
        objective=objective(problem, z, ends),
        multipliers=Multipliers(z.nu, path, zeros(n), zeros(problem.m), none),
        result=RESULTS.successful,
        residual=jnp.zeros((), t.dtype),
        problem=problem,
    )
    still = jax.lax.stop_gradient(extremal)
    size = still.sizes()
    worst = _worst(problem, size, *jax.lax.stop_gradient((z, ends)))
    extremal = differentiable_if(worst <= _CONVERGED, extremal, problem)
    return dataclasses.replace(extremal, residual=worst, result=judged(still, size, worst))


def _worst(problem: Problem, size: Sizes, z: Unknowns, ends: Float[Array, "arc two_n_1"]) -> Array:
    """The largest error of a boundary condition, relative to its size."""
    of = boundary_sizes(problem, ends.shape[0], size)
    of = jnp.where(jnp.isfinite(of), of, 1.0)
    return jnp.max(jnp.abs(boundary_residual(problem, z, ends)) / of)


def judged(extremal: Extremal, size: Sizes, worst: Float[Array, ""]) -> RESULTS:
    """Whether an extremal whose boundary conditions are missed by `worst`, relative to their sizes,
    converged, minimises H everywhere (Legendre-Clebsch), and keeps to its bounds."""
    problem, t, x, u = extremal.problem, extremal.t, extremal.x, extremal.u
    h_uu = jax.vmap(jax.hessian(hamiltonian, argnums=3), in_axes=(None, 0, 0, 0, 0))(
        problem, t, x, u, extremal.costate
    )
    minimising = jnp.all(jax.vmap(cholesky_positive)(h_uu))
    inside = [jnp.all(part <= _WITHIN) for part in oversteps(problem, t, x, u, size)]
    span = jnp.abs(t[-1] - t[0])
    for entry, time in ((problem.initial_time, t[0]), (problem.final_time, t[-1])):
        if is_free(entry):
            inside.append(overstep(time[None], (entry.lo, entry.hi))[0] <= _WITHIN * span)
    result = RESULTS.where(minimising, RESULTS.successful, RESULTS.not_minimising)
    result = RESULTS.where(jnp.all(jnp.stack(inside)), result, RESULTS.bounds_violated)
    result = RESULTS.where(jnp.isfinite(extremal.objective), result, RESULTS.undefined)
    return RESULTS.where(worst <= _CONVERGED, result, RESULTS.not_converged)
