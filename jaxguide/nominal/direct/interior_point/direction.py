"""The search direction: the Newton system of each kind of step, its inertia corrected.

Three kinds of step share one matrix, so that the factorisation is compiled once:

- Newton's: W of the Lagrangian, Sigma of the barrier; Waechter & Biegler (2006), eq. (11).
- towards feasibility: W = sqrt(mu) I: the least step, weighted by the barrier, that meets the
  linearised constraints. (They minimise the violation plus such a term, eq. (29a), instead.)
- an estimate of the multipliers: W + Sigma = I, by least squares; their eq. (36).
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, added, loop, on_numpy, xp
from jaxguide.nominal.direct.box import barrier_gradient
from jaxguide.nominal.direct.elimination import Segments, eliminate
from jaxguide.nominal.direct.interior_point.evaluation import Iterate
from jaxguide.nominal.direct.interior_point.state import Setup
from jaxguide.nominal.direct.kkt_factor import PENALTY, Factor, factorise
from jaxguide.nominal.direct.kkt_step import newton_step
from jaxguide.nominal.direct.newton_system import (
    COMPLIANCE,
    Load,
    NewtonSystem,
    lagrangian_gradient,
)
from jaxguide.nominal.direct.trees import choose, largest, zeros_like
from jaxguide.nominal.direct.unknowns import Equations, Primal, flattened

# Algorithm IC of Waechter & Biegler (2006), section 3.1: delta_w^min, delta_w^0, 1/kappa_w^-,
# kappa_w^+ and, before the first correction, its value with a bar.
_DELTA_MIN, _DELTA_FIRST, _FALL, _GROW, _GROW_FIRST = 1e-20, 1e-4, 3, 8.0, 100.0
# Their delta_w^max is 1e40; beside 1e12 a scaled Hessian is already down to its first digits.
_DELTA_MAX = 1e12
# Curvature lent to free knots, lest one that nothing needs wander. By experiment, the best of five
# values tried on such knots.
_IDLE = 1e-3


class Matrix(NamedTuple):
    """The Newton matrix, factorised. `delta`: its Hessian's regularisation; `regular`:
    whether its inertia is right; `needed`: the last positive delta that a Newton step needed."""

    system: NewtonSystem
    segments: Segments
    factor: Factor
    delta: Float[Array, ""]
    regular: Bool[Array, ""]
    needed: Float[Array, ""]


class Gradients(NamedTuple):
    """Gradients of the objective, and of the barrier with mu = 1."""

    objective: Float[Array, " unknown"]
    barrier: Float[Array, " unknown"]


class Move(NamedTuple):
    """A `Step`, its change of the unknowns as one vector: a direction d and the multipliers."""

    primal: Float[Array, " unknown"]
    dual: Equations


def gradients_of(setup: Setup, at: Iterate) -> Gradients:
    """The Gradients at an iterate."""
    program, w = setup.program, setup.program.shaped(at.state.w)
    of = lagrangian_gradient(program, at.nodes, at.ends, w, zeros_like(at.state.y))
    pull = barrier_gradient(setup.box, at.low, at.high, xp.ones_like(at.state.mu))
    return Gradients(flattened(of), pull)


def factorised(setup: Setup, at: Iterate) -> Matrix:
    """The matrix of this kind of step, regularised until its inertia is right."""
    program, s, kind = setup.program, at.state, at.kind
    w = program.shaped(s.w)
    hessians = program.hessians(w, s.y)
    at_nodes, at_ends = choose(kind.flat, zeros_like(hessians), hessians)
    sigma = _sigma(setup, at)
    given = program.shaped(setup.box.given)
    system = NewtonSystem(at.nodes, at.ends, at_nodes, at_ends, sigma, given)
    segments = eliminate(program, system)
    rho = PENALTY * (1 + largest((at_nodes, at_ends)))
    first = xp.where(kind.estimate, 1.0, xp.where(kind.restore, xp.sqrt(s.mu), 0.0))
    factorise_with = lambda delta: factorise(program, system, segments, delta, rho)
    delta, factor, regular = _corrected(factorise_with, first, s.delta)
    needed = xp.where(regular & ~kind.flat & (delta > 0), delta, s.delta)
    return Matrix(system, segments, factor, delta, regular, needed)


def _sigma(setup: Setup, at: Iterate) -> Primal:
    """The barrier's curvature z/distance; for an estimate, 1 for slacks and 0 for the others, to
    which the regularisation adds 1."""
    program, s = setup.program, at.state
    w = program.shaped(s.w)
    on = {name: name in ("path", "end") for name in Primal._fields}
    slacks = flattened(Primal(*(xp.full_like(getattr(w, k), on[k]) for k in on)))
    both = xp.where(at.kind.estimate, slacks, s.zl / at.low + s.zu / at.high)
    sigma = program.shaped(both)
    return sigma._replace(times=added(sigma.times, np.s_[2:], _IDLE))


def _corrected(
    factorise_with: Any, first: Array, last: Array
) -> tuple[Array, Factor, Bool[Array, ""]]:
    """Regularisation from `first` up, until the inertia is right: Waechter & Biegler (2006),
    Algorithm IC. `last`: the last one that was needed, or 0."""

    def attempt(carry: tuple) -> tuple:
        delta, _, _ = carry
        factor, ok = factorise_with(delta)
        again = xp.where(last > 0, xp.maximum(_DELTA_MIN, last / _FALL), _DELTA_FIRST)
        grow = xp.where(last > 0, _GROW, _GROW_FIRST)
        following = xp.where(delta > first, delta * grow, xp.maximum(again, _GROW * delta))
        return xp.where(ok, delta, following), factor, ok

    blank = None
    if not on_numpy(first):
        blank = jax.eval_shape(lambda d: factorise_with(d)[0], first)
        blank = jax.tree_util.tree_map(lambda a: xp.zeros(a.shape, a.dtype), blank)
    return loop(lambda a: ~a[2] & (a[0] < _DELTA_MAX), attempt, (first, blank, xp.array(False)))


def loaded(setup: Setup, at: Iterate, gradients: Gradients, c: Equations, mu: Array) -> Load:
    """The right-hand side of this kind of step, negated, for constraints `c` and barrier `mu`."""
    s, kind = at.state, at.kind
    bare = gradients.objective - s.zl + s.zu
    with_barrier = xp.where(kind.restore, 0.0, gradients.objective) + mu * gradients.barrier
    force = setup.program.shaped(xp.where(kind.estimate, bare, with_barrier))
    # The springs of path constraints start from the multipliers at hand.
    was = choose(kind.flat, zeros_like(s.y), s.y)
    return Load(force, c._replace(path=c.path + COMPLIANCE * was.path))


def direction(setup: Setup, matrix: Matrix, load: Load) -> Move:
    """The step for one right-hand side."""
    step = newton_step(setup.program, matrix.system, matrix.segments, matrix.factor, load)
    return Move(flattened(step.primal), step.dual)


def bound_multiplier_step(setup: Setup, at: Iterate, mu: Array, d: Array) -> tuple[Array, Array]:
    """Changes of the lower and upper bounds' multipliers with a step `d`.

    **Source:** Waechter & Biegler (2006), eq. (12).
    """
    s, box = at.state, setup.box
    rate = lambda z, a, on, sign: xp.where(on, mu / a - z - sign * z / a * d, 0.0)
    return rate(s.zl, at.low, box.below, 1.0), rate(s.zu, at.high, box.above, -1.0)
