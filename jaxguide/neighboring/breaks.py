"""Where the backward sweep breaks the horizon into segments, and the units it computes in."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.bounds import positive
from jaxguide.trajectory import Extremal

# Least number of times at which the canonical system is evaluated, and of those in a segment of the
# extremal; by experiment on the library.
_PROBES, _PER_SEGMENT = 256, 8
# Further probes of the last segment, at 1 - 2^-1 ... 1 - 2^-12 of it. Chosen, no experiment is
# recorded.
_HALVINGS = 12
# Segments shrink towards the end in proportion to the time left, down to this part of the horizon:
# hard constraints make the gain a ratio of small differences there. Chosen, no experiment is
# recorded.
_LAST = 2.0**-17
# Segments per e-fold of the time left; by experiment, on which problems is not recorded.
_GRADING = 0.8
# Added to the density of segments, `_EVEN` over the horizon and `_SHARE` of its mean: segments do
# not grow without limit where nothing happens. By experiment on the library.
_EVEN, _SHARE = 2.0, 0.1
# Weight of |M| in that density: a Picard sweep contracts by |M| times half the segment's length.
_CONTRACTION = 0.5


def probe_times(extremal: Extremal) -> Float[Array, " probe"]:
    """Times to look for rapid change: evenly within each of the extremal's own segments, and
    geometrically towards the end of the last."""
    breaks = extremal.breaks
    per = max(_PER_SEGMENT, -(-_PROBES // (breaks.shape[0] - 1)))
    even = np.arange(per) / per
    # Sorted here, not in the program: XLA's sort would take longer than all the rest.
    last = np.unique(np.append(even, 1 - 2.0 ** -np.arange(1.0, _HALVINGS + 1)))
    even, last = (jnp.asarray(v, breaks.dtype) for v in (even, last))
    times = breaks[:-2, None] + jnp.diff(breaks)[:-1, None] * even[None, :]
    graded = breaks[-2] + (breaks[-1] - breaks[-2]) * last
    return jnp.concatenate([times.reshape(-1), graded, breaks[-1:]])


def balancing_scale(
    extremal: Extremal, M: Float[Array, "probe two_n two_n"]
) -> Float[Array, " two_n"]:
    """Units of (dx, dlambda) in which M is balanced: states by their size, costates so that its
    blocks B and Q are equally large."""
    n = extremal.problem.n
    size = positive(jnp.max(jnp.abs(extremal.x), axis=0))
    B = jnp.max(jnp.abs(M[:, :n, n:] / (size[:, None] * size[None, :])[None]))
    Q = jnp.max(jnp.abs(M[:, n:, :n] * (size[:, None] * size[None, :])[None]))
    ratio = jnp.where((B > 0) & (Q > 0), Q / positive(B), 1 / positive(B))
    ratio = jnp.where(jnp.isfinite(ratio) & (ratio > 0), ratio, 1.0)
    beta = jnp.where((B > 0) & (Q > 0), jnp.sqrt(ratio), ratio)
    return jax.lax.stop_gradient(jnp.concatenate([size, beta / size]))


def place_breaks(
    t: Float[Array, " probe"], M: Float[Array, "probe two_n two_n"], segments: int
) -> Float[Array, " edge"]:
    r"""Breaks between which $|M'|/|M| + \sqrt{|M''|/|M|} + |M|/2$ and a floor have equal integrals,
    crowded towards the end.

    The first two terms are the inverse length over which M changes; |M| bounds the contraction of
    the Picard sweeps.
    """
    h = jnp.diff(t)
    norm = jnp.sqrt(jnp.sum(M**2, axis=(1, 2)))
    slope = jnp.diff(M, axis=0) / h[:, None, None]
    bend = jnp.diff(slope, axis=0) / ((h[1:] + h[:-1]) / 2)[:, None, None]
    size = lambda a: jnp.sqrt(jnp.sum(a**2, axis=(1, 2)))
    middle = (norm[1:] + norm[:-1]) / 2 + jnp.finfo(t.dtype).tiny
    bend = size(bend)
    bend = jnp.maximum(jnp.append(bend, bend[-1:]), jnp.concatenate([bend[:1], bend]))
    density = size(slope) / middle + jnp.sqrt(bend / middle) + _CONTRACTION * middle
    density = jnp.where(jnp.isfinite(density), density, 0.0)
    span = t[-1] - t[0]
    floor = _EVEN / span + _SHARE * jnp.sum(density * h) / span
    mass = jnp.concatenate([jnp.zeros(1, t.dtype), jnp.cumsum((density + floor) * h)])
    left = (t[-1] - t) / span + _LAST
    e_folds = jnp.log(left[0] / left)
    # The crowding takes at most half of the segments (chosen); the density places the others.
    grading = jnp.minimum(_GRADING, 0.5 * segments / e_folds[-1])
    mass = mass / mass[-1] * (segments - grading * e_folds[-1]) + grading * e_folds
    wanted = mass[-1] * jnp.linspace(0.0, 1.0, segments + 1, dtype=t.dtype)
    breaks = jnp.interp(wanted, mass, t).at[0].set(t[0]).at[-1].set(t[-1])
    return jax.lax.stop_gradient(breaks)
