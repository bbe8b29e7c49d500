"""The box that bounds the unknowns: distances to it, its barrier, and how far a step may go.

**Source:** Waechter & Biegler, Mathematical Programming 106 (2006).
"""

from typing import Any, NamedTuple, TypeAlias

import jax
from jaxtyping import Float

from jaxguide.arrays import Array, traced_once, xp
from jaxguide.nominal.direct.limits import Limits
from jaxguide.nominal.direct.trees import total

_tree = jax.tree_util.tree_map
Entries: TypeAlias = Any  # one number for each unknown: a Primal, or all of them as one vector

# kappa_d, damping of one-sided bounds: Waechter & Biegler (2006), section 3.7; the value is
# Ipopt's.
_KAPPA_D = 1e-5
# Room added to every bound, relative to it or to 1, so that a state may end on one and the interior
# is not empty: Waechter & Biegler (2006), eq. (35). Ipopt takes 1e-8; here the default tolerance.
_RELAX = 1e-9


class Box(NamedTuple):
    """Bounds, and which entries have them.

    - `below`, `above`: bool, whether an entry has a lower, an upper bound and may move.
    - `given`: bool, whether both bounds coincide, so that the entry may not move.
    """

    lo: Entries
    hi: Entries
    below: Entries
    above: Entries
    given: Entries


@traced_once
def boxed(limits: Limits) -> Box:
    """The box of `limits`, with a little room. An entry whose bounds coincide is given, unless it
    is a state: the defects determine those."""
    lo, hi = limits
    room = lambda b: _RELAX * xp.maximum(1.0, xp.abs(b))
    given = _tree(lambda a, b: a >= b, lo, hi)
    given = given._replace(x=xp.zeros_like(given.x))
    lo = _tree(lambda a, g: xp.where(g, a, a - room(a)), lo, given)
    hi = _tree(lambda b, g: xp.where(g, b, b + room(b)), hi, given)
    below = _tree(lambda a, g: xp.isfinite(a) & ~g, lo, given)
    above = _tree(lambda b, g: xp.isfinite(b) & ~g, hi, given)
    return Box(lo, hi, below, above, given)


def inside(box: Box, w: Entries, push: Any) -> Entries:
    """`w` moved inside its bounds, at least `push` away from them (relative to the bound or to 1,
    and to the distance of both); given entries at their values.

    **Source:** Waechter & Biegler (2006), section 3.6.
    """

    def one(w: Array, lo: Array, hi: Array, below: Array, above: Array, given: Array) -> Array:
        width = xp.where(below & above, hi - lo, xp.inf)
        step = lambda b: xp.minimum(push * xp.maximum(1.0, xp.abs(b)), push * width)
        w = xp.where(below, xp.maximum(w, lo + step(xp.where(below, lo, 0.0))), w)
        w = xp.where(above, xp.minimum(w, hi - step(xp.where(above, hi, 0.0))), w)
        return xp.where(given, lo, w)

    return _tree(one, w, box.lo, box.hi, box.below, box.above, box.given)


@traced_once
def distances(box: Box, w: Entries) -> tuple[Entries, Entries]:
    """Distances of `w` to its lower and upper bounds; 1 where there is no bound."""
    low = _tree(lambda w, b, on: xp.where(on, w - xp.where(on, b, 0.0), 1.0), w, box.lo, box.below)
    high = _tree(lambda w, b, on: xp.where(on, xp.where(on, b, 0.0) - w, 1.0), w, box.hi, box.above)
    return low, high


def complementarity(
    box: Box, low: Entries, high: Entries, zl: Entries, zu: Entries
) -> Float[Array, ""]:
    """Mean, over all bounds, of distance times multiplier; 0 if there is no bound."""
    both = _tree(lambda a, b, x, y: a * x + b * y, low, high, zl, zu)
    bounds = total(
        _tree(lambda a, b: xp.where(a, 1.0, 0.0) + xp.where(b, 1.0, 0.0), box.below, box.above)
    )
    return total(both) / xp.maximum(bounds, 1.0)


@traced_once
def barrier_value(box: Box, w: Entries, mu: Float[Array, ""]) -> Float[Array, ""]:
    """-mu sum log(distance), with the linear damping of one-sided bounds.

    **Source:** Waechter & Biegler (2006), eq. (3) and section 3.7.
    """
    low, high = distances(box, w)
    log = lambda a: xp.log(xp.where(a > 0, a, xp.nan))
    logs = total(_tree(lambda a, b: log(a) + log(b), low, high))
    one = lambda a, b, l, h: _KAPPA_D * (xp.where(l & ~h, a, 0.0) + xp.where(h & ~l, b, 0.0))
    return mu * (total(_tree(one, low, high, box.below, box.above)) - logs)


def barrier_gradient(box: Box, low: Entries, high: Entries, mu: Float[Array, ""]) -> Entries:
    """Gradient of `barrier_value`, from the distances."""

    def one(a: Array, b: Array, l: Array, h: Array) -> Array:
        lower = xp.where(l, -1 / a + xp.where(h, 0.0, _KAPPA_D), 0.0)
        upper = xp.where(h, 1 / b - xp.where(l, 0.0, _KAPPA_D), 0.0)
        return mu * (lower + upper)

    return _tree(one, low, high, box.below, box.above)


def longest_step(
    gap_low: Entries, gap_high: Entries, dw: Entries, box: Box, tau: Float[Array, ""]
) -> Float[Array, ""]:
    """The longest step, up to 1, that keeps the fraction 1 - tau of each distance.

    **Source:** Waechter & Biegler (2006), eq. (15a).
    """

    def one(a: Array, b: Array, d: Array, l: Array, h: Array) -> Array:
        low = xp.where(l & (d < 0), -tau * a / xp.where(d < 0, d, -1.0), xp.inf)
        high = xp.where(h & (d > 0), tau * b / xp.where(d > 0, d, 1.0), xp.inf)
        return xp.min(xp.minimum(low, high), initial=1.0)

    steps = jax.tree_util.tree_leaves(_tree(one, gap_low, gap_high, dw, box.below, box.above))
    return xp.min(xp.stack(steps))


def longest_dual_step(z: Entries, dz: Entries, tau: Float[Array, ""]) -> Float[Array, ""]:
    """The longest step, up to 1, that keeps the fraction 1 - tau of each bound's multiplier.

    **Source:** Waechter & Biegler (2006), eq. (15b).
    """
    one = lambda z, d: xp.min(
        xp.where(d < 0, -tau * z / xp.where(d < 0, d, -1.0), xp.inf), initial=1.0
    )
    return xp.min(xp.stack(jax.tree_util.tree_leaves(_tree(one, z, dz))))
