"""Derivatives of a converged direct solution with respect to its Problem and its mesh.

They follow by the implicit function theorem from the conditions of the last barrier problem, which
are smooth in every parameter, bound and break.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxguide.nominal.direct.box import Entries, barrier_gradient, boxed, distances
from jaxguide.nominal.direct.elimination import eliminate
from jaxguide.nominal.direct.interior_point import Solution
from jaxguide.nominal.direct.kkt_factor import PENALTY, factorise
from jaxguide.nominal.direct.kkt_step import newton_step
from jaxguide.nominal.direct.limits import limits_of
from jaxguide.nominal.direct.newton_system import (
    Load,
    NewtonSystem,
    Step,
    lagrangian_gradient,
    times_step,
)
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.trees import largest
from jaxguide.nominal.direct.unknowns import Primal

_tree = jax.tree_util.tree_map


def sensitivity(program: Transcription, solution: Solution, tangent: Any) -> Solution:
    """Change of `solution` per change `tangent` of `program`'s (problem, edges); transposable.

    Entries on a bound are held there by the barrier: at its last value mu its curvature is z^2/mu,
    and they move some mu/z^2 as far as free ones would. Where z is of the order of sqrt(mu) (a
    bound just touched, a singular arc) the derivative is that of the barrier problem, and the
    extremal's `degenerate` says so.
    """
    given = boxed(limits_of(program)).given
    conditions = lambda stated: _conditions(program, solution, given, stated)
    out, moved = eqx.filter_jvp(conditions, ((program.problem, program.edges),), (tangent,))
    fill = lambda t, o: jnp.zeros_like(o) if t is None else t
    moved = _tree(fill, moved, out, is_leaf=lambda t: t is None)
    (_, _, (low, high)), (load, d_given, (d_low, d_high)) = out, moved
    box, mu = boxed(limits_of(program)), solution.mu
    curve = lambda a, on: jnp.where(on, mu / a**2, 0.0)
    sigma = _tree(lambda a, b, l, h: curve(a, l) + curve(b, h), low, high, box.below, box.above)
    step = _implicit_step(program, solution, sigma, given, load)
    dw = _tree(jnp.add, step.primal, d_given)
    # z = mu/distance; a distance changes with its bound (already in d_low, d_high) and with w.
    dz = lambda a, d, on: jnp.where(on, -mu / a**2 * d, 0.0)
    d_zl = _tree(lambda a, b, d, on: dz(a, b + d, on), low, d_low, step.primal, box.below)
    d_zu = _tree(lambda a, b, d, on: dz(a, b - d, on), high, d_high, step.primal, box.above)
    zero = jnp.zeros_like(mu)
    return Solution(dw, step.dual, d_zl, d_zu, zero, None, None, zero, zero)  # pyright: ignore


def _conditions(
    program: Transcription, solution: Solution, given: Entries, stated: Any
) -> tuple[Load, Primal, tuple[Primal, Primal]]:
    """At the solution, for `stated`, a (problem, edges): the first-order conditions of the barrier
    problem, the given entries, and the distances to the bounds."""
    here = eqx.tree_at(lambda p: (p.problem, p.edges), program, stated)
    box = boxed(limits_of(here))
    at = _tree(lambda w, g, lo: jnp.where(g, lo, w), solution.w, given, box.lo)
    low, high = distances(box, at)
    nodes, ends = here.derivatives(at)
    _, c = here.objective_and_residual(at, (nodes.value, ends.value))
    force = lagrangian_gradient(here, nodes, ends, at, solution.y)
    force = _tree(jnp.add, force, barrier_gradient(box, low, high, solution.mu))
    force = _tree(lambda f, g: jnp.where(g, 0.0, f), force, given)
    fixed = _tree(lambda g, lo: jnp.where(g, lo, 0.0), given, box.lo)
    return Load(force, c), fixed, (low, high)


def _implicit_step(
    program: Transcription, solution: Solution, sigma: Primal, given: Primal, load: Load
) -> Step:
    """The Newton system at the solution, with the barrier's curvature `sigma`, solved for `load`:
    differentiable, in both directions, as a linear solve."""
    w, zero = solution.w, jnp.zeros_like(solution.mu)
    nodes, ends = program.derivatives(w)
    system = NewtonSystem(nodes, ends, *program.hessians(w, solution.y), sigma, given)
    segments = eliminate(program, system)
    rho = PENALTY * (1 + largest(system.node_hessian))
    factor, _ = factorise(program, system, segments, zero, rho)

    # One flat vector: transposition wants a right-hand side that is linear as a whole.
    right = Step(_tree(jnp.negative, load.force), _tree(jnp.negative, load.residual))
    flat, unravel = ravel_pytree(right)

    def product(v: jax.Array) -> jax.Array:
        load = times_step(program, system, zero, unravel(v))
        return ravel_pytree(Step(load.force, load.residual))[0]

    def solve(_: Any, v: jax.Array) -> jax.Array:
        step = unravel(-v)
        load = Load(step.primal, step.dual)
        return ravel_pytree(newton_step(program, system, segments, factor, load))[0]

    return unravel(jax.lax.custom_linear_solve(product, flat, solve, symmetric=True))
