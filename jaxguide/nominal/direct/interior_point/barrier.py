"""The barrier parameter mu: the monotone rule, the free rule by Mehrotra's probe, and tau.

**Source:** Waechter & Biegler (2006), eqs (7) and (8); for the free rule Nocedal, Waechter & Waltz
(2009). Where a constant is Ipopt's, it is the default of that option.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float

from jaxguide.arrays import Array, loop, put, xp
from jaxguide.nominal.direct.box import (
    complementarity,
    distances,
    longest_dual_step,
    longest_step,
)
from jaxguide.nominal.direct.interior_point.direction import Move, bound_multiplier_step
from jaxguide.nominal.direct.interior_point.evaluation import Iterate
from jaxguide.nominal.direct.interior_point.state import Options, Setup
from jaxguide.nominal.direct.trees import along

# kappa_eps, kappa_mu, theta_mu and tau_min: Waechter & Biegler (2006), section 2.1, eqs (7) and
# (8).
_KAPPA_EPS, _KAPPA_MU, _THETA_MU, _TAU_MIN = 10.0, 0.2, 1.5, 0.99
# The least barrier is the tolerance over this: Waechter & Biegler (2006), eq. (7).
_LEAST = 10
# The barrier is free while the error falls below `_FALL` of its worst at the last `MEMORY` iterates
# with a free barrier: Ipopt, adaptive_mu_kkterror_red_fact and adaptive_mu_kkterror_red_iters.
_FALL, MEMORY = 0.9999, 4
# Share of the mean complementarity at which a held barrier begins: Ipopt,
# adaptive_mu_monotone_init_factor.
_HELD = 0.8
# The barrier is free only below `_NEAR`. By experiment: free from the start, or where the problem
# is not convex, NPSAT1 took three times the iterations. A free one stays above `_AHEAD` of the
# error, lest complementarity hold long before the other conditions: chosen, no experiment is
# recorded.
_NEAR, _AHEAD = 1e-3, 1e-4
# Largest barrier of a probe: Ipopt, mu_max_fact, times the 0.1 of a cold start (where Ipopt takes
# the mean complementarity).
_MU_MAX = 1e2
_CENTRING = 3  # Mehrotra's exponent, as in Nocedal, Waechter & Waltz (2009)


class Barrier(NamedTuple):
    """The barrier of a step: `mu` (a probe may still change it if `free`), the fraction-to-boundary
    `tau`, the mean complementarity `gap`, and the `errors` that the next step will compare with."""

    mu: Float[Array, ""]
    free: Bool[Array, ""]
    tau: Float[Array, ""]
    gap: Float[Array, ""]
    errors: Float[Array, " memory"]


def barrier_of(setup: Setup, at: Iterate, delta: Float[Array, ""]) -> Barrier:
    """Free to follow a probe near a convex solution (`delta` = 0) while the error falls. Otherwise
    (monotone mode) mu begins at a share of the complementarity and stays until the barrier problem
    is solved to kappa_eps mu; then it falls.

    **Source:** Waechter & Biegler (2006), eqs (7) and (8).
    """
    s, newton, now = at.state, at.kind.newton, at.error_now
    gap = complementarity(setup.box, at.low, at.high, s.zl, s.zu)
    least = _least(setup.options)
    falls = now <= _FALL * xp.max(s.errors)
    free = newton & (delta == 0) & falls & (s.mu <= _NEAR)
    errors = xp.where(free, put(xp.roll(s.errors, 1), 0, now), s.errors)
    held = xp.where(newton & s.free & ~free, xp.maximum(least, _HELD * gap), s.mu)
    # Waechter & Biegler (2006), eq. (7).
    lower = lambda mu: xp.maximum(least, xp.minimum(_KAPPA_MU * mu, mu**_THETA_MU))
    solved = lambda mu: newton & ~free & (at.error(mu) <= _KAPPA_EPS * mu) & (mu > least)
    mu = loop(solved, lower, held)
    # Waechter & Biegler (2006), eq. (8); with a free barrier from the error, as in Ipopt.
    tau = xp.maximum(_TAU_MIN, 1 - xp.where(free, now, mu))
    return Barrier(mu, free, tau, gap, errors)


def probed(setup: Setup, at: Iterate, barrier: Barrier, step: Move) -> Float[Array, ""]:
    """Mehrotra's rule: mu = sigma gap with sigma = (gap after the step / gap)^3, the step being as
    much of `step`, computed for mu = 0, as the bounds allow.

    **Source:** Nocedal, Waechter & Waltz (2009), Mehrotra's probing heuristic.
    """
    s, box, gap, one = at.state, setup.box, barrier.gap, xp.ones_like(at.state.mu)
    dzl, dzu = bound_multiplier_step(setup, at, xp.zeros_like(s.mu), step.primal)
    alpha = longest_step(at.low, at.high, step.primal, box, one)
    alpha_z = xp.minimum(longest_dual_step(s.zl, dzl, one), longest_dual_step(s.zu, dzu, one))
    low, high = distances(box, along(s.w, alpha, step.primal))
    zl, zu = along(s.zl, alpha_z, dzl), along(s.zu, alpha_z, dzu)
    left = complementarity(box, low, high, zl, zu) / xp.where(gap > 0, gap, 1.0)
    # It may not run ahead of the other conditions.
    floor = xp.minimum(s.mu, xp.minimum(_AHEAD * at.error_now, at.error_now**_THETA_MU))
    return xp.clip(gap * left**_CENTRING, xp.maximum(_least(setup.options), floor), _MU_MAX)


def _least(options: Options) -> Array:
    return options.tolerance / _LEAST
