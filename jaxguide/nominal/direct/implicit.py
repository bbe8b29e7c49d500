"""Derivatives of a converged direct solution with respect to its Problem and its mesh, by the
implicit function theorem on the conditions of the last barrier problem: smooth in every parameter,
bound and break."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxguide.nominal.direct import elimination, kkt, newton
from jaxguide.nominal.direct.box import barrier_gradient, boxed, distances
from jaxguide.nominal.direct.interior_point import Solution
from jaxguide.nominal.direct.limits import bounds
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal

_tree = jax.tree_util.tree_map


def sensitivity(program: Transcription, solution: Solution, tangent: Any) -> Solution:
    """Change of `solution` per change `tangent` of `program`'s (problem, edges); transposable.

    Active bounds are held by their barrier: at its last value mu a bound's curvature is z^2/mu, so
    that it moves by mu/z of what a free one would. Where z is itself of the order of sqrt(mu) (a
    bound just touched, a singular arc) the derivative is that of the barrier problem, and the
    extremal's `degenerate` says so.
    """
    w, y, mu = solution.w, solution.y, solution.mu
    given = boxed(bounds(program)).given

    def conditions(stated: Any) -> tuple[newton.Load, Primal, tuple[Primal, Primal]]:
        here = eqx.tree_at(lambda p: (p.problem, p.edges), program, stated)
        box = boxed(bounds(here))
        at = _tree(lambda w, g, lo: jnp.where(g, lo, w), w, given, box.lo)
        low, high = distances(box, at)

        nodes, ends = here.derivatives(at)
        _, c = here.objective_and_residual(at, (nodes.value, ends.value))
        force = newton.gradient(here, nodes, ends, at, y)
        force = _tree(jnp.add, force, barrier_gradient(box, low, high, mu))
        force = _tree(lambda f, g: jnp.where(g, 0.0, f), force, given)
        fixed = _tree(lambda g, lo: jnp.where(g, lo, 0.0), given, box.lo)
        return newton.Load(force, c), fixed, (low, high)

    out, moved = eqx.filter_jvp(conditions, ((program.problem, program.edges),), (tangent,))
    fill = lambda t, o: jnp.zeros_like(o) if t is None else t
    moved = _tree(fill, moved, out, is_leaf=lambda t: t is None)
    (_, _, (low, high)), (load, d_given, (d_low, d_high)) = out, moved
    box = boxed(bounds(program))
    curve = lambda a, on: jnp.where(on, mu / a**2, 0.0)
    sigma = _tree(lambda a, b, l, h: curve(a, l) + curve(b, h), low, high, box.below, box.above)
    nodes, ends = program.derivatives(w)
    system = newton.System(nodes, ends, *program.hessians(w, y), sigma, given)
    segments = elimination.eliminate(program, system)
    zero = jnp.zeros_like(mu)
    largest = jnp.max(jnp.abs(system.node_hessian), initial=0.0)
    factor, _ = kkt.factorise(program, system, segments, zero, 1e2 * (1 + largest))

    # One flat vector: transposition wants a right-hand side that is linear as a whole.
    right = newton.Step(_tree(jnp.negative, load.force), _tree(jnp.negative, load.residual))
    flat, unravel = ravel_pytree(right)

    def product(v: jax.Array) -> jax.Array:
        load = newton.product(program, system, zero, unravel(v))
        return ravel_pytree(newton.Step(load.force, load.residual))[0]

    def solve(_: Any, v: jax.Array) -> jax.Array:
        step = unravel(-v)
        load = newton.Load(step.primal, step.dual)
        return ravel_pytree(kkt.solve(program, system, segments, factor, load))[0]

    step = unravel(jax.lax.custom_linear_solve(product, flat, solve, symmetric=True))
    dw = _tree(jnp.add, step.primal, d_given)
    # z = mu/distance; a distance changes with its bound (already in d_low, d_high) and with w.
    dz = lambda a, d, on: jnp.where(on, -mu / a**2 * d, 0.0)
    d_zl = _tree(lambda a, b, d, on: dz(a, b + d, on), low, d_low, step.primal, box.below)
    d_zu = _tree(lambda a, b, d, on: dz(a, b - d, on), high, d_high, step.primal, box.above)
    return Solution(dw, step.dual, d_zl, d_zu, zero, None, None, zero, zero)  # pyright: ignore
