"""Indirect multiple shooting: the necessary conditions solved to rounding, differentiably."""

import dataclasses
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.flatten_util
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from jaxguide.bounds import bounds_of
from jaxguide.conditions.angles import unwrap_angles
from jaxguide.conditions.canonical import canonical_rates
from jaxguide.conditions.control import minimising_control
from jaxguide.conditions.hamiltonian import hamiltonian
from jaxguide.conditions.sizes import end_sizes, state_sizes
from jaxguide.linalg import SmallLU, cholesky_positive
from jaxguide.nominal.indirect.boundary import Unknowns, boundary_residual, horizon
from jaxguide.nominal.indirect.coarse import coarse_ends, damped_newton, objective
from jaxguide.nominal.indirect.starts import random_start
from jaxguide.nominal.method import Capabilities, Method
from jaxguide.nominal.steps import dopri8
from jaxguide.problem import Problem, endpoint_count, is_free, start_value
from jaxguide.spectral import nodes_lgl
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.types import RESULTS

_COARSE_ITERATIONS, _COARSE_TOLERANCE = 60, 1e-7


class Shooting(Method):
    """Single (`arcs=1`) or multiple indirect shooting.

    Three stages, each in fixed shapes: damped Newton with coarse steps, from the guess or from
    `starts` random flights at once, the best converged one kept; an adaptive flight of it
    (Diffrax's Dopri8 at `tolerance`), whose steps lay the mesh; and Newton (Optimistix) with
    Dopri8 steps on that mesh, through which derivatives are implicit, forward and reverse.

    **Arguments:**

    - `arcs`: shooting arcs; 1 is single shooting. More arcs tolerate unstable dynamics.
    - `segments`, `degree`: the mesh of the returned Extremal (`segments` a multiple of `arcs`).
    - `tolerance`: relative and absolute, of the integration that lays the mesh.
    - `coarse_steps`: of the first stage, over the horizon.
    - `starts`, `seed`: how many random starts when no guess is given.

    **Error:** boundary conditions to about 1e-12 of their scale; the Certificate tells.
    """

    arcs: int = eqx.field(static=True, default=4)
    segments: int = eqx.field(static=True, default=32)
    degree: int = eqx.field(static=True, default=12)
    tolerance: float = eqx.field(static=True, default=1e-13)
    starts: int = eqx.field(static=True, default=32)
    coarse_steps: int = eqx.field(static=True, default=96)
    seed: int = eqx.field(static=True, default=0)
    max_steps: int = eqx.field(static=True, default=1024)
    accuracy: ClassVar[float] = 1e-9
    capabilities: ClassVar[Capabilities] = Capabilities(
        direct=False, array_guess="the initial costates"
    )

    def __check_init__(self):
        if self.arcs < 1 or self.segments < 1 or self.segments % self.arcs:
            raise ValueError(
                f"Shooting: segments={self.segments} must be a multiple of arcs={self.arcs} >= 1."
            )
        for name in ("starts", "coarse_steps", "max_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"Shooting: {name}={getattr(self, name)}; need at least 1.")
        if self.degree < 2:
            raise ValueError(f"Shooting: degree={self.degree}; need at least 2.")
        if not 0 < self.tolerance < 1:
            raise ValueError(f"Shooting: tolerance={self.tolerance}; give one in (0, 1).")

    def __call__(self, problem: Problem, guess: Any) -> Extremal:
        dtype = jnp.result_type(float)
        frozen = jax.lax.stop_gradient(problem)
        if guess is None:
            z = jax.lax.stop_gradient(self._multistart(frozen, dtype))
        else:
            z = jax.lax.stop_gradient(self._from_guess(frozen, guess, dtype))
        z, fractions = jax.lax.stop_gradient(self._lay_mesh(frozen, z))
        return self._on_mesh(problem, z, fractions)

    @property
    def _arc_steps(self) -> int:
        return -(-self.coarse_steps // self.arcs)

    def _multistart(self, problem: Problem, dtype: Any) -> Unknowns:
        keys = jax.random.split(jax.random.key(self.seed), self.starts)

        def attempt(key: Array) -> tuple[Unknowns, Array, Array]:
            z = random_start(problem, key, self.arcs, self._arc_steps, dtype)
            return damped_newton(problem, z, self._arc_steps, _COARSE_ITERATIONS)

        zs, norms, costs = jax.vmap(attempt)(keys)
        norms = jnp.where(jnp.isfinite(norms), norms, jnp.inf)
        converged = (norms < _COARSE_TOLERANCE) & jnp.isfinite(costs)
        by_cost = jnp.argmin(jnp.where(converged, costs, jnp.inf))
        best = jnp.where(jnp.any(converged), by_cost, jnp.argmin(norms))
        return jax.tree_util.tree_map(lambda a: a[best], zs)

    def _from_guess(self, problem: Problem, guess: Any, dtype: Any) -> Unknowns:
        """`guess` as unknowns, improved by the coarse Newton where that converges."""
        z = self._unknowns(problem, guess, dtype)
        better, norm, _ = damped_newton(problem, z, self._arc_steps, _COARSE_ITERATIONS)
        return jax.tree_util.tree_map(
            lambda a, b: jnp.where(norm < _COARSE_TOLERANCE, a, b), better, z
        )

    def _unknowns(self, problem: Problem, guess: Any, dtype: Any) -> Unknowns:
        none = jnp.zeros((0,), dtype)
        pick = lambda spec, value: jnp.asarray(value, dtype)[None] if is_free(spec) else none
        if isinstance(guess, Extremal):
            times = jnp.linspace(guess.t[0], guess.t[-1], self.arcs + 1)[:-1]
            y = jnp.concatenate([guess.x, guess.costate], axis=1)
            return Unknowns(
                jax.vmap(lambda t: guess.interpolate(y, t))(times),
                guess.multipliers.endpoint,
                pick(problem.initial_time, guess.t[0]),
                pick(problem.final_time, guess.t[-1]),
            )
        costate = jnp.asarray(guess, dtype)
        if costate.shape != (problem.n,):
            raise ValueError(
                f"guess has shape {costate.shape}; give an Extremal or the {problem.n} initial "
                f"costates of {problem.state_names}."
            )
        x0 = random_start(problem, jax.random.key(0), 1, 1, dtype).starts[0, : problem.n]
        z = Unknowns(
            jnp.concatenate([x0, costate])[None],
            jnp.zeros((endpoint_count(problem),), dtype),
            pick(problem.initial_time, start_value(problem.initial_time)),
            pick(problem.final_time, start_value(problem.final_time)),
        )
        # Fly it once, arc by arc, and take nu from the transversality condition it ends with.
        ends = []
        for k in range(self.arcs):
            part = self._arc_window(problem, z, k)
            end = coarse_ends(part, z, self._arc_steps)[0, : 2 * problem.n]
            ends.append(z.starts[0])
            z = z._replace(starts=end[None])
        n = problem.n
        t0, tf = horizon(problem, z)
        j_e = jax.jacfwd(problem.endpoint_constraints, argnums=1)(x0, z.starts[0, :n], t0, tf)
        g_e = jax.grad(problem.endpoint_cost, argnums=1)(x0, z.starts[0, :n], t0, tf)
        nu = jnp.linalg.lstsq(j_e.T, z.starts[0, n:] - g_e)[0] if j_e.shape[0] else z.nu
        return z._replace(starts=jnp.stack(ends), nu=nu)

    def _arc_window(self, problem: Problem, z: Unknowns, k: int) -> Problem:
        t0, tf = horizon(problem, z)
        a, b = t0 + (tf - t0) * k / self.arcs, t0 + (tf - t0) * (k + 1) / self.arcs
        where = lambda p: (p.initial_time, p.final_time)
        return eqx.tree_at(where, problem, (a, b), is_leaf=lambda v: v is None or is_free(v))

    def _lay_mesh(self, problem: Problem, z: Unknowns) -> tuple[Unknowns, Array]:
        """Where the mesh's segments should break, as fractions of the horizon: where adaptive
        integration at `tolerance` steps. Arcs are moved to begin at such breaks."""
        t0, tf = horizon(problem, z)
        fractions = jnp.linspace(0.0, 1.0, self.arcs + 1, dtype=z.starts.dtype)
        times = t0 + (tf - t0) * fractions
        y = jnp.concatenate([z.starts, jnp.zeros((self.arcs, 1), z.starts.dtype)], axis=1)
        solve_arc = lambda y, a, b: diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: canonical_rates(args, t, y)),
            diffrax.Dopri8(),
            a,
            b,
            None,
            y,
            args=problem,
            saveat=diffrax.SaveAt(steps=True),
            stepsize_controller=diffrax.PIDController(rtol=self.tolerance, atol=self.tolerance),
            max_steps=self.max_steps,
            adjoint=diffrax.ForwardMode(),  # never differentiated: the lightest there is
            throw=False,
        )
        solution = jax.vmap(solve_arc)(y, times[:-1], times[1:])
        ts, ys = solution.ts, solution.ys  # ts is inf beyond the last step
        assert ts is not None and ys is not None
        # Equal numbers of steps per segment, mixed with uniform spacing as a floor.
        scaled = jnp.where(jnp.isfinite(ts), (ts - t0) / (tf - t0), 2.0).reshape(-1)
        order = jnp.argsort(scaled)
        scaled, ys = scaled[order], ys.reshape(-1, ys.shape[2])[order, : 2 * problem.n]
        used = jnp.sum(scaled <= 1.5)
        count = jnp.minimum(jnp.arange(1, scaled.shape[0] + 1), used).astype(scaled.dtype)
        zero = jnp.zeros(1, scaled.dtype)
        grid = jnp.concatenate([zero, jnp.minimum(scaled, 1.0)])
        density = 0.8 * jnp.concatenate([zero, count]) / used.astype(scaled.dtype) + 0.2 * grid
        wanted = jnp.linspace(0.0, 1.0, self.segments + 1, dtype=scaled.dtype)
        breaks = jnp.interp(wanted, density, grid).at[0].set(0.0).at[-1].set(1.0)
        # Arcs begin at a step actually taken, whose state is known to full accuracy.
        per_arc = self.segments // self.arcs
        nearest = lambda s: jnp.argmin(jnp.abs(scaled - s))
        step = jax.vmap(nearest)(breaks[per_arc:-1:per_arc])
        breaks = breaks.at[per_arc:-1:per_arc].set(scaled[step])
        starts = jnp.concatenate([z.starts[:1], ys[step]])
        breaks = jnp.sort(breaks)
        ok = jnp.all(jnp.isfinite(starts)) & jnp.all(jnp.diff(breaks) > 0)
        uniform = jnp.linspace(0.0, 1.0, self.segments + 1, dtype=scaled.dtype)
        return (
            z._replace(starts=jnp.where(ok, starts, z.starts)),
            jnp.where(ok, breaks, uniform),
        )

    def _on_mesh(self, problem: Problem, z: Unknowns, breaks: Array) -> Extremal:
        p = self.degree + 1
        tau = jnp.asarray(nodes_lgl(p)[0], z.starts.dtype)
        inner = breaks[:-1, None] + jnp.diff(breaks)[:, None] * (tau[None, :-1] + 1) / 2
        fractions = jnp.concatenate([inner.reshape(-1), breaks[-1:]])
        per_arc = (fractions.shape[0] - 1) // self.arcs
        index = jnp.arange(self.arcs)[:, None] * per_arc + jnp.arange(per_arc + 1)[None, :]

        def fly(z: Unknowns, problem: Problem) -> Array:
            t0, tf = horizon(problem, z)
            times = t0 + (tf - t0) * fractions
            y = jnp.concatenate([z.starts, jnp.zeros((self.arcs, 1), z.starts.dtype)], axis=1)
            rate = lambda t, y: canonical_rates(problem, t, y)
            return jax.vmap(lambda y, ts: dopri8(rate, y, ts))(y, times[index])

        def residual(z: Unknowns, problem: Problem) -> Array:
            return boundary_residual(problem, z, fly(z, problem)[:, -1])

        z = _if_finite(_newton(residual, z, problem), z)
        arcs = fly(z, problem)
        y = jnp.concatenate([arcs[:, :-1].reshape(-1, arcs.shape[2]), arcs[-1, -1:]])
        t0, tf = horizon(problem, z)
        t = t0 + (tf - t0) * fractions
        n = problem.n
        x, costate = y[:, :n], y[:, n : 2 * n]
        u = jax.vmap(lambda t, x, c: minimising_control(problem, t, x, c))(t, x, costate)
        u = unwrap_angles(problem, t, x, u)
        worst = jnp.max(jnp.abs(boundary_residual(problem, z, arcs[:, -1])))
        zeros = lambda k: jnp.zeros((t.shape[0], k), t.dtype)
        size = jax.eval_shape(problem.path_constraints, t[0], x[0], u[0]).shape[0]
        cost = objective(problem, z, arcs[:, -1])
        extremal = Extremal(
            t=t,
            x=x,
            u=u,
            reference_nodes=tau,
            costate=costate,
            final_time=tf,
            objective=cost,
            multipliers=Multipliers(
                z.nu, zeros(size), zeros(n), zeros(problem.m), jnp.zeros(0, t.dtype)
            ),
            result=_judge(problem, t, x, u, costate, worst, cost),
            residual=worst,
            problem=problem,
        )
        # In units where everything is small, `worst` alone would pass.
        e = problem.endpoint_constraints(x[0], x[-1], t0, tf)
        miss = jnp.abs(e - bounds_of(problem.endpoint_bounds, e.shape[0], e.dtype)[0])
        there = jnp.all(
            miss <= 1e-7 * end_sizes(problem, t, x, state_sizes(problem, t, x, u))
        ) | jnp.isnan(cost)
        result = RESULTS.where(there, extremal.result, RESULTS.not_converged)
        return dataclasses.replace(extremal, result=result)


def _newton(residual: Any, z: Unknowns, problem: Problem) -> Unknowns:
    """The root, differentiated implicitly."""
    return optx.root_find(
        residual,
        optx.Newton(rtol=1e-12, atol=1e-12, linear_solver=SmallLU()),
        z,
        problem,
        max_steps=20,
        adjoint=optx.ImplicitAdjoint(linear_solver=SmallLU()),
        throw=False,
    ).value


def _if_finite(new: Unknowns, old: Unknowns) -> Unknowns:
    """`new`, or `old` where Newton met a singular Jacobian: a failure then shows what it missed."""
    ok = jnp.all(jnp.isfinite(jax.flatten_util.ravel_pytree(new)[0]))
    return jax.tree_util.tree_map(lambda a, b: jnp.where(ok, a, b), new, old)


def _judge(
    problem: Problem, t: Array, x: Array, u: Array, costate: Array, worst: Array, cost: Array
) -> RESULTS:
    """What the shot extremal is worth."""
    scale = 1 + jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(costate))
    converged = worst <= 1e-9 * scale  # Newton is quadratic: short of this it did not converge
    h_uu = jax.vmap(jax.hessian(hamiltonian, argnums=3), in_axes=(None, 0, 0, 0, 0))(
        problem, t, x, u, costate
    )
    minimising = jnp.all(jax.vmap(cholesky_positive)(h_uu))
    slack = 1e-9
    xlo, xhi = bounds_of(problem.state_bounds, problem.n, x.dtype)
    ulo, uhi = bounds_of(problem.control_bounds, problem.m, u.dtype)
    path = jax.vmap(problem.path_constraints)(t, x, u)
    plo, phi = bounds_of(problem.path_bounds, path.shape[1], path.dtype)
    inside = lambda v, lo, hi: jnp.all((v >= lo[None] - slack) & (v <= hi[None] + slack))
    legal = inside(x, xlo, xhi) & inside(u, ulo, uhi) & inside(path, plo, phi)
    result = RESULTS.where(minimising, RESULTS.successful, RESULTS.not_minimising)
    result = RESULTS.where(legal, result, RESULTS.bounds_violated)
    result = RESULTS.where(jnp.isfinite(cost), result, RESULTS.undefined)
    return RESULTS.where(converged, result, RESULTS.not_converged)
