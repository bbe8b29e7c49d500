"""The next state: the new iterate, its bounds' multipliers, and the kind of the next step."""

from typing import NamedTuple

import jax
from jaxtyping import Bool, Float, Int

from jaxguide.arrays import Array, either, xp
from jaxguide.nominal.direct.box import barrier_value, distances, longest_dual_step
from jaxguide.nominal.direct.interior_point.barrier import Barrier
from jaxguide.nominal.direct.interior_point.direction import Matrix, bound_multiplier_step
from jaxguide.nominal.direct.interior_point.evaluation import Iterate
from jaxguide.nominal.direct.interior_point.filter import acceptable, augmented
from jaxguide.nominal.direct.interior_point.line_search import Found
from jaxguide.nominal.direct.interior_point.state import (
    ESTIMATE,
    INFEASIBLE,
    NEWTON,
    RESTORE,
    RUNNING,
    STALLED,
    TOO_MANY,
    Options,
    Setup,
    State,
)
from jaxguide.nominal.direct.trees import along, choose, largest, one_norm, zeros_like
from jaxguide.nominal.direct.unknowns import Equations

# kappa_Sigma, the bounds' multipliers within this factor of mu/distance: Waechter & Biegler (2006),
# eq. (16).
_KAPPA_SIGMA = 1e10
# Largest first estimate of a multiplier: lambda_max of Waechter & Biegler (2006), section 3.6. If
# any is larger, all are 0.
_MULTIPLIERS_MAX = 1e3
# Restoration ends at this share of the violation at which it began: kappa_resto of Waechter &
# Biegler (2006), section 3.3. It also ends at a violation of a tenth of the tolerance, which leaves
# nothing to restore: chosen, not tuned.
_KAPPA_RESTO, _FEASIBLE = 0.9, 10
# Share of the violation by which a step of restoration must lower it: more than rounding. Chosen,
# not tuned.
_NO_LESS = 1e-12
# If a step fails at a violation below this or the tolerance, the larger, the search has stalled;
# otherwise the problem is infeasible. Chosen, not tuned: the square root of rounding.
_LEAST_VIOLATION = 1e-8


class Moved(NamedTuple):
    """Unknowns and multipliers after a step."""

    w: Float[Array, " unknown"]
    y: Equations
    zl: Float[Array, " unknown"]
    zu: Float[Array, " unknown"]


class Restoration(NamedTuple):
    """Whether a step ended feasibility restoration (`home`), makes it necessary (`into`), or failed
    in it (`stuck`)."""

    home: Bool[Array, ""]
    into: Bool[Array, ""]
    stuck: Bool[Array, ""]


def following(setup: Setup, at: Iterate, matrix: Matrix, barrier: Barrier, found: Found) -> State:
    """The state after the step that the line search found."""
    s, kind, options = at.state, at.kind, setup.options
    point = _moved(setup, at, barrier, found)
    restoration = _restoration_after(setup, at, point, found)
    mode = xp.where((kind.restore & ~restoration.home) | restoration.into, RESTORE, NEWTON)
    mode = xp.where(restoration.home, ESTIMATE, mode)
    # A step that is not of f-type, and the point that restoration leaves, add a corner:
    # Waechter & Biegler (2006), eq. (22).
    add = (found.accepted & kind.newton & ~found.f_type) | restoration.into
    filter = augmented(found.filter, found.theta, found.phi, add)
    return State(
        w=point.w,
        y=point.y,
        zl=point.zl,
        zu=point.zu,
        mu=found.mu,
        filter=filter,
        theta_max=s.theta_max,
        theta_min=s.theta_min,
        theta_entry=xp.where(restoration.into, found.theta, s.theta_entry),
        delta=matrix.needed,
        mode=mode.astype(s.mode.dtype),
        iteration=s.iteration + 1,
        status=_status(options, at, restoration).astype(s.status.dtype),
        error=at.error_now,
        free=barrier.free,
        errors=barrier.errors,
    )


def _moved(setup: Setup, at: Iterate, barrier: Barrier, found: Found) -> Moved:
    """The new iterate, if the step was accepted; new multipliers alone, after an estimate.

    **Source:** Waechter & Biegler (2006), eqs (14)-(16); eq. (36) for the estimate.
    """
    s, kind, box, mu, d = at.state, at.kind, setup.box, found.mu, found.taken.primal
    dzl, dzu = bound_multiplier_step(setup, at, mu, d)
    tau = barrier.tau
    alpha_z = xp.minimum(longest_dual_step(s.zl, dzl, tau), longest_dual_step(s.zu, dzu, tau))
    w = along(s.w, found.alpha, d)
    low, high = distances(box, w)
    # Waechter & Biegler (2006), eq. (16).
    keep = lambda z, a, on: xp.where(
        on, xp.clip(z, mu / (_KAPPA_SIGMA * a), _KAPPA_SIGMA * mu / a), 0.0
    )
    zl = keep(along(s.zl, alpha_z, dzl), low, box.below)
    zu = keep(along(s.zu, alpha_z, dzu), high, box.above)
    change = jax.tree_util.tree_map(lambda new, old: new - old, found.taken.dual, s.y)
    y = along(s.y, found.alpha, change)
    modest = found.regular & (largest(found.step.dual) <= _MULTIPLIERS_MAX)
    estimated = choose(modest, found.step.dual, zeros_like(s.y))
    new_y = choose(kind.estimate, estimated, choose(found.accepted & ~kind.restore, y, s.y))
    new_zl, new_zu = choose(found.accepted, (zl, zu), (s.zl, s.zu))
    return Moved(choose(found.accepted, w, s.w), new_y, new_zl, new_zu)


def _restoration_after(setup: Setup, at: Iterate, point: Moved, found: Found) -> Restoration:
    """Whether restoration begins, ends or fails.

    **Source:** Waechter & Biegler (2006), section 3.3.
    """
    (program, box, options), s, kind = setup, at.state, at.kind
    # Only restoration needs the new values: other steps save the evaluation.
    evaluate = lambda: program.objective_and_residual(program.shaped(point.w))
    f, c = either(kind.restore, evaluate, lambda: (at.f, at.c))
    theta, phi = one_norm(c), f + barrier_value(box, point.w, found.mu)
    less = theta <= _KAPPA_RESTO * s.theta_entry
    home = (less & acceptable(found.filter, theta, phi)) | (
        largest(c) <= options.tolerance / _FEASIBLE
    )
    failed = ~found.accepted & ~kind.estimate
    # Against a bound steps are accepted that rounding swallows.
    still = kind.restore & ~home & (theta >= (1 - _NO_LESS) * one_norm(at.c))
    return Restoration(
        found.accepted & kind.restore & home, failed & kind.newton, failed & kind.restore | still
    )


def _status(options: Options, at: Iterate, restoration: Restoration) -> Int[Array, ""]:
    """Whether the iterations go on, or why not."""
    feasible = largest(at.c) <= xp.maximum(_LEAST_VIOLATION, options.tolerance)
    status = xp.where(restoration.stuck, xp.where(feasible, STALLED, INFEASIBLE), RUNNING)
    status = xp.where(restoration.into & feasible, STALLED, status)
    last = at.state.iteration + 1 >= options.max_iterations
    return xp.where(last & (status == RUNNING), TOO_MANY, status)
