"""The guess that a direct solve starts from: straight, random or from an extremal."""

import functools
import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, added, on_numpy, xp
from jaxguide.conditions.units import REST, natural_units
from jaxguide.nominal.direct.stated import beginning, stated_bounds
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal
from jaxguide.nominal.starts import UNBOUNDED, bounds_middle, control_ends, drawn_final_time
from jaxguide.problem import (
    Problem,
    initially_free,
    is_free,
    parameters,
    start_value,
)
from jaxguide.problem.points import rates
from jaxguide.spectral.grids import evaluation
from jaxguide.trajectory import Extremal, Point
from jaxguide.transforms.endless import evened

# Constant controls that are tried where states rest: distances from the middle of a control's
# range, as shares of it. Chosen for the brachistochrone, whose start is singular at rest.
_SHARES = (0.0, -0.25, 0.25)
# A random horizon is within a factor of two of the guess, and random waves of the states are a
# third of their natural unit: chosen, not tuned.
_SPREAD, _WAVE = math.log(2), 3


def edges(fractions: Float[Array, " edge"], knots: tuple[int, ...]) -> Float[Array, "edge clock"]:
    """Break points, at `fractions` of the horizon, as linear combinations of (t0, tf, knots): each
    between the two nearest of them. `knots`: which breaks are free."""
    last = fractions.shape[0] - 1
    main = np.array([0, *sorted(knots), last])
    column = np.array([0, *range(2, 2 + len(knots)), 1])
    j = np.arange(last + 1)
    left = np.clip(np.searchsorted(main, j, side="right") - 1, 0, len(main) - 2)
    a, b = fractions[main[left]], fractions[main[left + 1]]
    share = (fractions - a) / (b - a)
    out = np.zeros((last + 1, 2 + len(knots)), fractions.dtype)
    return added(added(out, (j, column[left]), 1 - share), (j, column[left + 1]), share)


def straight_guess(
    program: Transcription, fractions: Float[Array, " edge"], knots: tuple[int, ...]
) -> Primal:
    """States on a straight line to the nearest ends that meet the endpoint constraints; controls
    in the middle of their bounds. In user units."""
    counts, at = program.counts, beginning(program.problem)
    s = fractions_at(fractions, program.rule.support[1:])
    x = at.x0[None, None] + s[:, :, None] * (at.xf - at.x0)[None, None]
    over = lambda u: xp.broadcast_to(u, (counts.segments, counts.nodes, counts.m))
    times = placed(at.t0, at.tf, fractions, knots)
    straight = without_slacks(program, at.x0, x, over(at.u), times, at.p)
    lo, hi = stated_bounds(program.problem).u
    unbounded, middle = xp.isinf(lo) | xp.isinf(hi), xp.clip(xp.zeros_like(lo), lo, hi)
    u = middle + (at.u - middle) * _natural_units(program, straight)[1]
    u = xp.where(unbounded, u, at.u)
    rests = at.unasked & (xp.abs(at.x0) < REST) & (xp.abs(at.xf) < REST)
    rests = rests & ~np.asarray(initially_free(program.problem))
    return propagated(program, straight._replace(u=over(u)), rests)


def _natural_units(program: Transcription, w: Primal) -> tuple[Array, Array]:
    return natural_units(evened(program.problem), w.times, w.x0, w.x, w.u)


def propagated(program: Transcription, w: Primal, rests: Bool[Array, " n"]) -> Primal:
    """`w` with the states `rests`, which start at zero and need meet no end, integrated along it.

    Where a start is singular at rest (a brachistochrone's, without speed), the middle control may
    leave them there. The one of three constant controls that fits the other states' rates best is
    taken.
    """
    if on_numpy(rests) and not np.any(rests):
        return w
    dtype, bounds = program.dtype, stated_bounds(program.problem)
    lo, hi = bounds.u
    width = xp.where(xp.isfinite(lo) & xp.isfinite(hi), hi - lo, 0.0)
    spans = program.clocks @ w.times
    h, middle = (spans[:, 1] - spans[:, 0])[:, None], (spans[:, 0] + spans[:, 1]) / 2
    ends = xp.concatenate([w.x0[None], w.x[:, -1]])
    across, halfway = xp.diff(ends, axis=0), (ends[1:] + ends[:-1]) / 2
    rate = lambda x, u: rates(program.problem, middle, x, u)[0]

    def gains(share: float) -> tuple[Array, Array]:
        """The change of the resting states over each segment, and the misfit of the others."""
        u = w.u[:, 0] + share * width[None]
        gained = h * rate(halfway, u)
        gained = xp.where(rests[None] & xp.isfinite(gained), gained, 0.0)
        left = h * rate(halfway + xp.cumsum(gained, axis=0) - gained / 2, u) - across
        return gained, xp.sum(xp.where(rests[None], 0.0, xp.abs(left)))

    shares = xp.asarray(_SHARES, dtype)
    tries, misfit = (xp.stack(a) for a in zip(*map(gains, _SHARES), strict=True))
    misfit = xp.where(xp.isfinite(misfit), misfit, xp.inf)
    best = xp.argmin(misfit * (1 + xp.abs(shares)))  # the middle if alike
    gained, share = tries[best], xp.where(xp.any(rests), xp.take(shares, best), 0.0)
    along = xp.asarray((program.rule.support[1:] + 1) / 2, dtype)
    start = xp.cumsum(gained, axis=0) - gained
    more = start[:, None] + along[None, :, None] * gained[:, None]
    x = xp.clip(w.x + more, bounds.x[0][None, None], bounds.x[1][None, None])
    return w._replace(x=xp.where(rests[None, None], x, w.x), u=w.u + (share * width)[None, None])


def random_guess(
    program: Transcription, fractions: Float[Array, " edge"], knots: tuple[int, ...], key: Array
) -> Primal:
    """The straight guess, bent at random, in user units: states by two sine waves of a third of
    their natural unit, within their bounds; controls on a line between two random values; a free
    final time within a factor of two."""
    w, counts = straight_guess(program, fractions, knots), program.counts
    dtype, rule = program.dtype, program.rule
    draws = _draws(key, counts.n, counts.m, dtype)
    if on_numpy(w.x0):
        draws = jax.device_get(draws)
    bounds, (of_x, of_u) = stated_bounds(program.problem), _natural_units(program, w)
    waves = draws.x * of_x[None] / _WAVE
    s = fractions_at(fractions, rule.support[1:])
    bent = sum(xp.sin((k + 1) * np.pi * s)[..., None] * waves[k][None, None] for k in range(2))
    x = xp.clip(w.x + bent, *(side[None, None] for side in bounds.x))
    centre = bounds_middle(program.problem, dtype)
    ends = control_ends(program.problem, draws.u, centre, UNBOUNDED * of_u)
    ends = xp.clip(ends, *(side[None] for side in bounds.u))
    s = fractions_at(fractions, rule.nodes)[..., None]
    u = ends[0][None, None] * (1 - s) + ends[1][None, None] * s
    times = w.times
    if is_free(program.problem.final_time):
        end = drawn_final_time(program.problem, draws.t, times[0], times[1])
        times = placed(times[0], end, fractions, knots)
    return w._replace(x=x, u=u, times=times)


class _Draws(NamedTuple):
    """Standard normal amplitudes of the states' waves, uniform ends of the controls on [-1, 1], and
    the logarithm of the factor by which the horizon is longer."""

    x: Float[Array, "two n"]
    u: Float[Array, "two m"]
    t: Float[Array, ""]


@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def _draws(key: Array, n: int, m: int, dtype: Any) -> _Draws:
    k_x, k_u, k_t = jax.random.split(key, 3)
    return _Draws(
        jax.random.normal(k_x, (2, n), dtype),
        jax.random.uniform(k_u, (2, m), dtype, -1.0, 1.0),
        jax.random.uniform(k_t, (), dtype, -_SPREAD, _SPREAD),
    )


def placed(t0: Array, tf: Array, fractions: Array, knots: tuple[int, ...]) -> Float[Array, " k"]:
    """t0, tf and the knots, at their fractions of the horizon."""
    inner = t0 + (tf - t0) * fractions[np.array(sorted(knots), int)]
    return xp.concatenate([xp.stack([t0, tf]), inner])


def without_slacks(
    program: Transcription, x0: Array, x: Array, u: Array, times: Array, p: Array
) -> Primal:
    """A guess whose slacks are zero, to be set from the constraints' values."""
    counts, dtype = program.counts, program.dtype
    path = xp.zeros((counts.segments, counts.nodes, counts.path), dtype)
    return Primal(x0, x, u, times, p, path, xp.zeros(counts.end, dtype))


def fractions_at(fractions: Float[Array, " edge"], tau: np.ndarray) -> Float[Array, "segment k"]:
    """The points `tau` of every segment, as fractions of the horizon."""
    local = xp.asarray((tau[None] + 1) / 2, fractions.dtype)
    return fractions[:-1, None] + xp.diff(fractions)[:, None] * local


def from_extremal(
    program: Transcription,
    fractions: Float[Array, " edge"],
    knots: tuple[int, ...],
    problem: Problem,
    guess: Extremal,
) -> Primal:
    """States and controls of `guess` at this mesh's times. In user units."""
    counts, rule, dtype = program.counts, program.rule, program.dtype
    t0, tf = guess.t[0], guess.t[-1]
    at = lambda tau: t0 + (tf - t0) * fractions_at(fractions, tau)
    fill = lambda y, k: xp.concatenate(
        [y, xp.zeros((*y.shape[:-1], k - y.shape[-1]), dtype)], axis=-1
    )
    x = fill(points_between(guess, at(rule.support[1:])).x, counts.n)
    u = fill(points_between(guess, at(rule.nodes)).u, counts.m)
    p = [xp.asarray(start_value(v), dtype) for v in parameters(guess.problem, like=problem)]
    p = xp.stack(p) if p else xp.zeros(0, dtype)
    times = placed(t0, tf, fractions, knots)
    return without_slacks(program, fill(guess.x[0], counts.n), x, u, times, p)


def points_between(guess: Extremal, times: Float[Array, "segment k"]) -> Point:
    """`Extremal.point` at many times."""
    if not on_numpy(guess.t, times):
        return jax.vmap(jax.vmap(guess.point))(times)
    values = xp.concatenate([guess.x, guess.u, guess.costate], axis=1)
    before = None
    if guess.u_before is not None and guess.costate_before is not None:
        ends = values[guess.degree :: guess.degree, : guess.x.shape[1]]
        before = xp.concatenate([ends, guess.u_before, guess.costate_before], axis=1)
    found = interpolated(guess, values, times, before)
    return Point(*xp.split(found, np.cumsum([guess.x.shape[1], guess.u.shape[1]]), axis=2))


def interpolated(
    guess: Extremal, values: Array, times: Float[Array, "segment k"], before: Any = None
) -> Float[Array, "segment k c"]:
    """`Extremal.interpolate` of nodal `values` at many times; `before`: the values just before the
    breaks, where they jump there."""
    if not on_numpy(values, times):
        return jax.vmap(jax.vmap(lambda t: guess.interpolate(values, t)))(times)
    p = len(guess.reference_nodes)
    breaks = guess.t[:: p - 1]
    parts = values[np.arange(len(breaks) - 1)[:, None] * (p - 1) + np.arange(p)]
    if before is not None:
        parts[:, -1] = before
    t = xp.clip(times.reshape(-1), breaks[0], breaks[-1])
    s = xp.clip(xp.searchsorted(breaks, t, side="right") - 1, 0, len(breaks) - 2)
    a, b = breaks[s], breaks[s + 1]
    rows: Any = evaluation(
        np.asarray(guess.reference_nodes), (2 * t - a - b) / np.where(b > a, b - a, 1.0)
    )
    return (rows[:, None] @ parts[s])[:, 0].reshape(*times.shape, -1)
