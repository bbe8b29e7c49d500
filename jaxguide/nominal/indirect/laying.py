"""Where the mesh of a shot extremal breaks: where an adaptive integrator steps."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.canonical import canonical_rates
from jaxguide.linalg import power_of_two
from jaxguide.nominal.indirect.boundary import Unknowns, horizon
from jaxguide.nominal.steps import adaptive_steps
from jaxguide.problem import Problem

_UNIFORM = 0.2  # share of the breaks that are spaced evenly, so that no segment is a whole horizon
_FAR = 1e3  # a value smaller than 1 by this, or larger, is integrated in units of its own size


def laid_mesh(
    problem: Problem, z: Unknowns, arcs: int, segments: int, tolerance: float, max_steps: int
) -> tuple[Unknowns, Float[Array, " edge"]]:
    """Breaks of `segments` segments as fractions of the horizon, with equal numbers of integration
    steps in each; and `z` with its arcs moved to begin at such breaks. Not for differentiation."""
    n, (t0, tf) = problem.n, horizon(problem, z)
    ts, ys = _steps(problem, z, arcs, tolerance, max_steps)
    fractions = jnp.where(jnp.isfinite(ts), (ts - t0) / (tf - t0), 2.0).reshape(-1)
    order = jnp.argsort(fractions)
    fractions, ys = fractions[order], ys.reshape(-1, ys.shape[2])[order, : 2 * n]
    breaks = _shared_out(fractions, segments)
    # Arcs begin at a step actually taken, whose state is known to full accuracy.
    per_arc = segments // arcs
    nearest = lambda s: jnp.argmin(jnp.abs(fractions - s))
    step = jax.vmap(nearest)(breaks[per_arc:-1:per_arc])
    breaks = breaks.at[per_arc:-1:per_arc].set(fractions[step])
    starts = jnp.concatenate([z.starts[:1], ys[step]])
    breaks = jnp.sort(breaks)
    ok = jnp.all(jnp.isfinite(starts)) & jnp.all(jnp.diff(breaks) > 0)
    uniform = jnp.linspace(0.0, 1.0, segments + 1, dtype=fractions.dtype)
    return z._replace(starts=jnp.where(ok, starts, z.starts)), jnp.where(ok, breaks, uniform)


def _steps(
    problem: Problem, z: Unknowns, arcs: int, tolerance: float, max_steps: int
) -> tuple[Float[Array, "arc step"], Float[Array, "arc step two_n_1"]]:
    """Times (inf beyond the last step) and values of an adaptive flight of every arc."""
    t0, tf = horizon(problem, z)
    times = t0 + (tf - t0) * jnp.linspace(0.0, 1.0, arcs + 1, dtype=z.starts.dtype)
    y = jnp.concatenate([z.starts, jnp.zeros((arcs, 1), z.starts.dtype)], axis=1)
    unit = _units(y)
    rate = lambda t, s: canonical_rates(problem, t, s * unit) / unit
    fly = lambda s, a, b: adaptive_steps(rate, s, a, b, tolerance, max_steps)
    ts, ys = jax.vmap(fly)(y / unit[None], times[:-1], times[1:])
    return ts, ys * unit[None, None]


def _units(y: Float[Array, "arc two_n_1"]) -> Float[Array, " two_n_1"]:
    """What the integrator's absolute tolerance is relative to: 1, or where values are far from it
    their size, as a power of two, by which nothing is rounded."""
    size = jnp.max(jnp.abs(y), axis=0)
    far = (size > _FAR) | ((size > 0) & (size < 1 / _FAR))
    return jnp.where(far, power_of_two(size), 1.0)


def _shared_out(fractions: Float[Array, " step"], segments: int) -> Float[Array, " edge"]:
    """Breaks with as many of the ascending steps `fractions` in each segment, mixed with even
    spacing; steps beyond 1 are none."""
    used = jnp.sum(fractions <= 1.5)
    count = jnp.minimum(jnp.arange(1, fractions.shape[0] + 1), used).astype(fractions.dtype)
    zero = jnp.zeros(1, fractions.dtype)
    grid = jnp.concatenate([zero, jnp.minimum(fractions, 1.0)])
    share = jnp.concatenate([zero, count]) / used.astype(fractions.dtype)
    density = (1 - _UNIFORM) * share + _UNIFORM * grid
    wanted = jnp.linspace(0.0, 1.0, segments + 1, dtype=fractions.dtype)
    return jnp.interp(wanted, density, grid).at[0].set(0.0).at[-1].set(1.0)
