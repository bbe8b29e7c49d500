"""One number for many flights: quantiles, tail means, and soft bounds."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from jaxguide.montecarlo.statistics import normal_quantile


def quantile(values: Float[Array | np.ndarray, " case"], level: float) -> Float[Array, ""]:
    """The `level` quantile, linear between order statistics.

    Its derivative depends only on the two cases next to the quantile: exact, but noisy; see
    `smooth_quantile`.

    **Raises:** `ValueError` for a level outside (0, 1).
    """
    _check_level(level, "quantile")
    return jnp.quantile(jnp.asarray(values), level)


def smooth_quantile(values: Float[Array | np.ndarray, " case"], level: float) -> Float[Array, ""]:
    """Harrell and Davis's estimate of a quantile: a mean of all order statistics, weighted by a
    beta distribution about `level`.

    It scatters less than `quantile`, and its derivative depends on many cases; it is biased
    outwards where the tail is long and cases are few.

    **Raises:** `ValueError` for a level outside (0, 1).

    **Source:** Harrell & Davis, Biometrika 69 (1982).
    """
    _check_level(level, "smooth_quantile")
    weights = _harrell_davis(values.shape[0], level)
    return jnp.sum(jnp.asarray(weights, values.dtype) * jnp.sort(values))


@functools.cache
def _harrell_davis(count: int, level: float) -> np.ndarray:
    a, b = (count + 1) * level, (count + 1) * (1 - level)
    return np.diff(scipy.special.betainc(a, b, np.arange(count + 1) / count))


def cvar(values: Float[Array | np.ndarray, " case"], level: float) -> Float[Array, ""]:
    r"""Mean of the worst 1 - `level` of the cases: $\min_a a + E[(v - a)^+]/(1 - level)$.

    The minimum is at the quantile, so its derivative is taken at fixed `a` (Danskin's theorem); a
    case at the quantile is counted in part.

    **Raises:** `ValueError` for a level outside (0, 1).

    **Source:** Rockafellar & Uryasev, Journal of Risk 2 (2000), eq. (9).
    """
    _check_level(level, "cvar")
    values, count = jnp.asarray(values), values.shape[0]
    # The order statistic with `level` of the cases below it; any minimiser would do. 1e-9 absorbs
    # the rounding of level * count where that is an integer.
    rank = min(int(np.ceil(level * count - 1e-9)), count) - 1
    a = jax.lax.stop_gradient(jnp.sort(values)[max(rank, 0)])
    excess = jnp.where(values > a, values - a, 0.0)
    # Cases at `a` share the part of the tail that cases beyond it do not fill; they add nothing to
    # the value, and the rest of the derivative.
    at = (values == a).astype(values.dtype)
    beyond = jnp.sum((values > a).astype(values.dtype))
    share = jnp.maximum((1 - level) * count - beyond, 0.0) / jnp.sum(at)
    return a + (jnp.sum(excess) + share * jnp.sum(at * (values - a))) / ((1 - level) * count)


def above(value: Any, bound: Any, width: Any = 0.0) -> Float[Array, ""]:
    r"""Soft constraint of an objective: $\max(value/bound - 1, 0)^2$, zero where it is met.

    Relative to the bound, so that one weight serves misses and loads.

    **Arguments:** `width`: rounds the corner, $\max(y, 0)$ becoming $w\,\mathrm{softplus}(y/w)$; a
    value less than `width` (of the bound) below it then costs a little too.
    """
    off = jnp.asarray(value) / bound - 1
    if isinstance(width, (int, float)) and width == 0:
        return jnp.maximum(off, 0.0) ** 2
    return (width * jax.nn.softplus(off / width)) ** 2


def _check_level(level: float, name: str) -> None:
    if not 0 < level < 1:
        raise ValueError(f"{name}: level is {level}; give a fraction in (0, 1), such as 0.99.")


def quantile_bounds(
    values: Any, level: float, confidence: float = 0.95
) -> tuple[float, float, float]:
    """(low, quantile, high): distribution-free bounds from order statistics, the number of cases
    below a quantile being binomial. Host only."""
    _check_level(level, "quantile_bounds")
    ordered = np.sort(np.asarray(values, float))
    n = ordered.size
    spread = normal_quantile(0.5 + confidence / 2) * np.sqrt(n * level * (1 - level))
    low, high = int(np.floor(n * level - spread)) - 1, int(np.ceil(n * level + spread))
    return (
        float(ordered[low]) if low >= 0 else -np.inf,
        float(np.quantile(ordered, level)),
        float(ordered[high]) if high < n else np.inf,
    )
