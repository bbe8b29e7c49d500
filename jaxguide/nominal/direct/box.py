"""The bounds of a program's unknowns: distances to them, the barrier, and how far a step may go.

**Source:** A. Waechter & L. T. Biegler, Mathematical Programming 106 (2006), section 3.
"""

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.nominal.direct.limits import Bounds

_tree = jax.tree_util.tree_map
Entries: TypeAlias = Any  # one number an unknown: a Primal, or all of them as one vector

_KAPPA_D = 1e-5  # damping of one-sided bounds
_RELAX = 1e-9  # of every bound, so that a state may end on one and the interior is not empty


class Box(NamedTuple):
    """Bounds with what follows from them."""

    lo: Entries
    hi: Entries
    below: Entries  # bool: has a lower bound and may move
    above: Entries
    given: Entries


@jax.jit
def boxed(bounds: Bounds) -> Box:
    """Bounds with a little room; entries whose bounds coincide are given, but for states."""
    lo, hi = bounds
    room = lambda b: _RELAX * jnp.maximum(1.0, jnp.abs(b))
    given = _tree(lambda a, b: a >= b, lo, hi)
    given = given._replace(x=jnp.zeros_like(given.x))
    lo = _tree(lambda a, g: jnp.where(g, a, a - room(a)), lo, given)
    hi = _tree(lambda b, g: jnp.where(g, b, b + room(b)), hi, given)
    below = _tree(lambda a, g: jnp.isfinite(a) & ~g, lo, given)
    above = _tree(lambda b, g: jnp.isfinite(b) & ~g, hi, given)
    return Box(lo, hi, below, above, given)


def inside(box: Box, w: Entries, push: Any) -> Entries:
    """`w` moved well within its bounds, given entries put where they belong (section 3.6)."""

    def one(w: Array, lo: Array, hi: Array, below: Array, above: Array, given: Array) -> Array:
        width = jnp.where(below & above, hi - lo, jnp.inf)
        step = lambda b: jnp.minimum(push * jnp.maximum(1.0, jnp.abs(b)), push * width)
        w = jnp.where(below, jnp.maximum(w, lo + step(jnp.where(below, lo, 0.0))), w)
        w = jnp.where(above, jnp.minimum(w, hi - step(jnp.where(above, hi, 0.0))), w)
        return jnp.where(given, lo, w)

    return _tree(one, w, box.lo, box.hi, box.below, box.above, box.given)


@jax.jit
def distances(box: Box, w: Entries) -> tuple[Entries, Entries]:
    """Distances to the bounds, 1 where there is none."""
    low = _tree(
        lambda w, b, on: jnp.where(on, w - jnp.where(on, b, 0.0), 1.0), w, box.lo, box.below
    )
    high = _tree(
        lambda w, b, on: jnp.where(on, jnp.where(on, b, 0.0) - w, 1.0), w, box.hi, box.above
    )
    return low, high


def total(tree: Any) -> Array:
    return sum((jnp.sum(a) for a in jax.tree_util.tree_leaves(tree)), jnp.zeros(()))


def complementarity(box: Box, low: Entries, high: Entries, zl: Entries, zu: Entries) -> Array:
    """Mean of distance times multiplier over all bounds; 0 where there is none."""
    both = _tree(lambda a, b, x, y: a * x + b * y, low, high, zl, zu)
    count = total(
        _tree(lambda a, b: jnp.where(a, 1.0, 0.0) + jnp.where(b, 1.0, 0.0), box.below, box.above)
    )
    return total(both) / jnp.maximum(count, 1.0)


@jax.jit
def barrier_value(box: Box, w: Entries, mu: Array) -> Array:
    """-mu sum log of the distances, with the linear damping of one-sided bounds (section 3.7)."""
    low, high = distances(box, w)
    log = lambda a: jnp.log(jnp.where(a > 0, a, jnp.nan))
    logs = total(_tree(lambda a, b: log(a) + log(b), low, high))
    one = lambda a, b, l, h: _KAPPA_D * (jnp.where(l & ~h, a, 0.0) + jnp.where(h & ~l, b, 0.0))
    return mu * (total(_tree(one, low, high, box.below, box.above)) - logs)


def barrier_gradient(box: Box, low: Entries, high: Entries, mu: Array) -> Entries:
    """Gradient of `barrier_value`."""

    def one(a: Array, b: Array, l: Array, h: Array) -> Array:
        lower = jnp.where(l, -1 / a + jnp.where(h, 0.0, _KAPPA_D), 0.0)
        upper = jnp.where(h, 1 / b - jnp.where(l, 0.0, _KAPPA_D), 0.0)
        return mu * (lower + upper)

    return _tree(one, low, high, box.below, box.above)


def longest_step(gap_low: Entries, gap_high: Entries, dw: Entries, box: Box, tau: Array) -> Array:
    """The longest step, up to 1, that keeps the fraction 1 - tau of each distance (eq. 15a)."""

    def one(a: Array, b: Array, d: Array, l: Array, h: Array) -> Array:
        low = jnp.where(l & (d < 0), -tau * a / jnp.where(d < 0, d, -1.0), jnp.inf)
        high = jnp.where(h & (d > 0), tau * b / jnp.where(d > 0, d, 1.0), jnp.inf)
        return jnp.min(jnp.minimum(low, high), initial=1.0)

    steps = jax.tree_util.tree_leaves(_tree(one, gap_low, gap_high, dw, box.below, box.above))
    return jnp.min(jnp.stack(steps))


def longest_dual_step(z: Entries, dz: Entries, tau: Array) -> Array:
    one = lambda z, d: jnp.min(
        jnp.where(d < 0, -tau * z / jnp.where(d < 0, d, -1.0), jnp.inf), initial=1.0
    )
    return jnp.min(jnp.stack(jax.tree_util.tree_leaves(_tree(one, z, dz))))
