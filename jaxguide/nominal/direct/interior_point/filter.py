"""The filter: pairs of constraint violation theta and barrier function phi, none of which may be at
least as good as a trial point in both.

**Source:** Waechter & Biegler (2006), section 2.3.
"""

from typing import Any, NamedTuple

from jaxtyping import Bool, Float, Int

from jaxguide.arrays import Array, put, xp
from jaxguide.nominal.direct.trees import choose

# gamma_theta and gamma_phi, margins of sufficient progress: Waechter & Biegler (2006), eq. (18).
GAMMA = 1e-5
# Pairs that the filter holds; a further one takes the place of the oldest. Chosen, not tuned: the
# filter is emptied whenever the barrier changes.
_SLOTS = 128


class Filter(NamedTuple):
    """Corners (theta, phi) of the region that is forbidden; `used`: how many were ever added."""

    theta: Float[Array, " slot"]
    phi: Float[Array, " slot"]
    used: Int[Array, ""]


def empty_filter(dtype: Any) -> Filter:
    """A filter that forbids nothing. (The bound theta_max of Waechter & Biegler (2006), eq. (21),
    is held apart.)"""
    slots = xp.full(_SLOTS, -xp.inf, dtype)
    return Filter(slots, slots, xp.zeros((), xp.int32))


def acceptable(filter: Filter, theta: Float[Array, ""], phi: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether (theta, phi) lies outside the filter: better in one of the two than every corner."""
    better = (theta < filter.theta) | (phi < filter.phi)
    live = xp.arange(_SLOTS, dtype=filter.used.dtype) < filter.used
    return xp.all(better | ~live)


def augmented(
    filter: Filter, theta: Float[Array, ""], phi: Float[Array, ""], add: Bool[Array, ""]
) -> Filter:
    """The filter with a corner at (theta, phi), less the margins, if `add`.

    **Source:** Waechter & Biegler (2006), eq. (22).
    """
    at = filter.used % _SLOTS
    new = Filter(
        put(filter.theta, at, (1 - GAMMA) * theta),
        put(filter.phi, at, phi - GAMMA * theta),
        filter.used + 1,
    )
    return choose(add, new, filter)
