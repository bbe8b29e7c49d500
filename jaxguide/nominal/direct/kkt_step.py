"""A Newton step of a transcription from its factorised matrix, one right-hand side at a time.

First a particular solution of each segment's defects; then a sweep from the last segment to the
first for the linear part of the value; the dense system of the global unknowns; a sweep forward for
the states and controls; last the multipliers of the defects, and the slacks.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, added, cho_solve, loop, put, scan, solve_triangular, xp
from jaxguide.nominal.direct.elimination import (
    Segments,
    basic_entries,
    over_segments,
    path_springs,
)
from jaxguide.nominal.direct.kkt_factor import Factor, flexibility, sweep_layout
from jaxguide.nominal.direct.newton_system import COMPLIANCE, Load, NewtonSystem, Step, times_step
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.trees import largest, zeros_like
from jaxguide.nominal.direct.unknowns import Equations, Primal

# Iterative refinement: at most `_REFINEMENTS` after the first solution, until the step leaves
# `_ENOUGH` of the forces and of the residuals, some 1e4 roundings: the last step, and the only one
# of a linear-quadratic problem, is then the solution to rounding. Chosen, not tuned.
_REFINEMENTS, _ENOUGH = 2, 1e-12
_LEAST_RESIDUAL = 1e-15  # rounding: residuals below it are zero


class _Particular(NamedTuple):
    """States, controls and nodes' inputs that meet the defects with v = 0."""

    x: Float[Array, "segment after n"]
    u: Float[Array, "segment node m"]
    q: Float[Array, "segment node xu"]


class _Sweep(NamedTuple):
    """The backward sweep's results: the linear part of the value at the start, minus the z of each
    segment at theta = 0, and the linear part of the value after each segment."""

    p: Float[Array, " theta"]
    k: Float[Array, "segment z"]
    p_after: Float[Array, "segment theta"]


class _Globals(NamedTuple):
    """The solution of the dense system, and the part of it that is static parameters."""

    theta: Float[Array, " theta"]
    nu: Float[Array, " q"]
    parameters: Float[Array, " parameter"]


class _Forward(NamedTuple):
    """Changes of states, controls and nodes' inputs, and the multiplier of each segment's end."""

    x: Float[Array, "segment after n"]
    u: Float[Array, "segment node m"]
    q: Float[Array, "segment node in"]
    costate: Float[Array, "segment n"]


def newton_step(
    program: Transcription, system: NewtonSystem, segments: Segments, factor: Factor, load: Load
) -> Step:
    """The solution for one right-hand side, refined where it needs to be: stiff barriers lose
    digits in the reduced Hessian, but not in the product with the matrix."""
    add = lambda a, b: jax.tree_util.tree_map(xp.add, a, b)
    # What must not move is held by forces that no step balances.
    unheld = lambda given, force: xp.where(given, 0.0, force)
    load = load._replace(force=jax.tree_util.tree_map(unheld, system.given, load.force))
    enough_force = _ENOUGH * xp.maximum(1.0, largest(load.force))
    enough_residual = _ENOUGH * largest(load.residual) + _LEAST_RESIDUAL

    def refine(carry: tuple) -> tuple:
        count, step, left, _ = carry
        step = add(step, eliminated_step(program, system, segments, factor, left))
        left = add(load, times_step(program, system, factor.delta, step))
        good = (largest(left.force) <= enough_force) & (largest(left.residual) <= enough_residual)
        return count + 1, step, left, good

    blank = zeros_like(Step(load.force, load.residual))
    return loop(
        lambda a: ~a[3] & (a[0] <= _REFINEMENTS), refine, (0, blank, load, xp.array(False))
    )[1]


def eliminated_step(
    program: Transcription, system: NewtonSystem, segments: Segments, factor: Factor, load: Load
) -> Step:
    """The solution for one right-hand side, by elimination alone."""
    force, residual = load
    load = load._replace(force=force._replace(u=xp.where(system.given.u, 0.0, force.u)))
    stiffness, share = path_springs(system)
    pushed = stiffness * residual.path + share * force.path

    bar = _particular(program, segments, residual)
    h = _pull(program, system, segments, factor, load, bar, pushed)
    sweep = _backward(factor, h, bar)
    ends = _global_step(program, system, factor, load, sweep)
    moved = _forward(program, segments, factor, bar, sweep, ends)
    defect = _defect_multipliers(program, system, segments, factor, load, moved, pushed)

    # Path and endpoint slacks, from their equations.
    h_q = system.nodes.jacobian[:, :, program.counts.n + 1 :]
    h_dq = (h_q @ moved.q[..., None])[..., 0]
    path = stiffness * h_dq + pushed
    d_path = h_dq + residual.path - COMPLIANCE * path
    at = sweep_layout(program.counts)
    d_end = system.ends.jacobian[1:] @ ends.theta[: at.xf.stop] + residual.end
    primal = Primal(
        ends.theta[at.start],
        moved.x,
        xp.where(system.given.u, 0.0, moved.u),
        ends.theta[at.times],
        ends.parameters,
        xp.where(system.given.path, 0.0, d_path),
        xp.where(system.given.end, 0.0, d_end),
    )
    return Step(primal, Equations(defect, path, ends.nu))


def _flat(a: Array) -> Array:
    """Points and their entries as rows: (segment, row, v)."""
    return a.reshape(a.shape[0], -1, a.shape[3])


def _by_segment(a: Array) -> Array:
    return a.reshape(a.shape[0], -1)


def _particular(program: Transcription, segments: Segments, residual: Equations) -> _Particular:
    """Basic entries that undo the defects, the others zero."""
    counts, rule = program.counts, program.rule
    n, m, S, C = counts.n, counts.m, counts.segments, counts.nodes

    def one(item: tuple) -> Array:
        basis, place, size, c = item
        moved = put(xp.zeros_like(size), np.s_[..., : c.shape[-1]], -basic_entries(basis, c))
        return xp.take_along_axis(moved, place, axis=-1) / size

    items = (segments.basis, segments.place, segments.size, _by_segment(residual.defect))
    both = over_segments(one, items)
    x = both[:, : counts.after * n].reshape(S, -1, n)
    u = both[:, counts.after * n :].reshape(S, C, m)
    at_nodes = xp.pad(x, ((0, 0), (1, 0), (0, 0)))[:, rule.first : rule.first + C]
    return _Particular(x, u, xp.concatenate([at_nodes, u], axis=2))


def _pull(
    program: Transcription,
    system: NewtonSystem,
    segments: Segments,
    factor: Factor,
    load: Load,
    bar: _Particular,
    pushed: Array,
) -> Float[Array, "segment v"]:
    """The forces on v that the load and the particular solution leave."""
    n, m = program.counts.n, program.counts.m
    force = load.force
    f = (factor.W[..., : n + m] @ bar.q[..., None])[..., 0]
    f = added(f, np.s_[:, :, n : n + m], program.roughness(bar.u))
    f = f + (pushed[:, :, None] @ system.nodes.jacobian[:, :, n + 1 :])[:, :, 0]
    on_states = force.x + (system.sigma.x + factor.delta) * bar.x
    back = lambda a, on: (xp.swapaxes(_flat(a), 1, 2) @ on.reshape(on.shape[0], -1, 1))[..., 0]
    return back(segments.T, f) + back(segments.X, on_states) + back(segments.U, force.u)


def _backward(factor: Factor, h: Float[Array, "segment v"], bar: _Particular) -> _Sweep:
    """The linear part of the value, last segment first."""
    stages = factor.stages
    n, nu = bar.x.shape[2], stages.factor.shape[1]

    def back(p: Array, item: tuple) -> tuple[Array, tuple]:
        s, h, x_end = item
        ahead = p + s.P[:, :n] @ x_end
        rest = xp.concatenate([h[:n], h[n + nu :]])
        h_u = h[n : n + nu] + s.X_u.T @ ahead[:n]
        h_t = s.L.T @ rest + s.X_t.T @ ahead[:n] + put(ahead, np.s_[:n], 0.0)
        k = cho_solve(s.factor, h_u)
        return h_t - s.N.T @ k, (k, p)

    zero = xp.zeros(stages.P.shape[1], h.dtype)
    p, (k, p_after) = scan(back, zero, (stages, h, bar.x[:, -1]), reverse=True)
    return _Sweep(p, k, p_after)


def _global_step(
    program: Transcription, system: NewtonSystem, factor: Factor, load: Load, sweep: _Sweep
) -> _Globals:
    """The global unknowns, by the eigenvectors of their matrix, refined once."""
    force, residual = load
    at = sweep_layout(program.counts)
    own_force = xp.concatenate([force.x0, force.times, force.p])
    p = added(sweep.p, np.s_[: at.moving], own_force)
    pulled = xp.where(system.given.end, 0.0, flexibility(system) * force.end)
    rhs = -xp.concatenate([p, residual.end + pulled])
    rhs = xp.where(factor.held, 0.0, rhs) / factor.equilibrium
    invert = lambda r: factor.vectors @ ((factor.vectors.T @ r) / factor.eigenvalues)
    solution = invert(rhs)
    solution = (solution + invert(rhs - factor.K @ solution)) / factor.equilibrium
    theta, nu = solution[: at.theta], solution[at.theta :]
    return _Globals(theta, nu, theta[at.p])


def _forward(
    program: Transcription,
    segments: Segments,
    factor: Factor,
    bar: _Particular,
    sweep: _Sweep,
    ends: _Globals,
) -> _Forward:
    """States and controls, first segment first."""
    n, m, at = program.counts.n, program.counts.m, sweep_layout(program.counts)

    def forward(theta: Array, item: tuple) -> tuple[Array, tuple]:
        s, X, x_end, k, p_after, clock = item
        z = -(s.KN @ theta + k)
        v = xp.concatenate([theta[at.start], z, clock @ theta[at.times], ends.parameters])
        after = put(theta, at.start, X @ v + x_end)
        return after, (v, s.P[:n] @ after + p_after[:n])

    by_segment = (sweep.k, sweep.p_after, program.clocks)
    items = (factor.stages, segments.X[:, -1], bar.x[:, -1], *by_segment)
    _, (v, costate) = scan(forward, ends.theta, items)
    of = lambda a: (_flat(a) @ v[..., None]).reshape(a.shape[:3])
    dx, du = of(segments.X) + bar.x, of(segments.U) + bar.u
    dq = added(of(segments.T), np.s_[:, :, : n + m], bar.q)
    return _Forward(dx, du, dq, costate)


def _defect_multipliers(
    program: Transcription,
    system: NewtonSystem,
    segments: Segments,
    factor: Factor,
    load: Load,
    moved: _Forward,
    pushed: Array,
) -> Float[Array, "segment row n"]:
    """Multipliers with which the force on each state after the start, and on each control,
    vanishes."""
    counts, rule = program.counts, program.rule
    n, m, S, C = counts.n, counts.m, counts.segments, counts.nodes
    own = slice(rule.first, rule.first + C)
    h_xu = system.nodes.jacobian[:, :, n + 1 :][..., : n + m]
    f = (factor.W[:, :, : n + m] @ moved.q[..., None])[..., 0]
    f = added(f, np.s_[:, :, n:], program.roughness(moved.u))
    f = f + (pushed[:, :, None] @ h_xu)[:, :, 0]
    on_states = xp.zeros((S, counts.after + 1, n), f.dtype)
    on_states = put(on_states, np.s_[:, own], f[..., :n])[:, 1:]
    on_states = on_states + load.force.x + (system.sigma.x + factor.delta) * moved.x
    # Forces that a next segment's nodes put on a shared end are in its own value.
    on_states = added(on_states, np.s_[:, -1], moved.costate)
    on_controls = f[..., n:] + load.force.u

    def one(item: tuple) -> Array:
        basis, order, size, f = item
        f = xp.take_along_axis(f / size, order[..., : basis.shape[-1]], axis=-1)
        f = solve_triangular(basis, f, lower=True, unit_diagonal=True)
        return -solve_triangular(basis, f)

    both = xp.concatenate([_by_segment(on_states), _by_segment(on_controls)], axis=1)
    rows = over_segments(one, (segments.basis, segments.order, segments.size, both))
    return rows.reshape(S, -1, n)
