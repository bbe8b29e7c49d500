"""Counts as real numbers, so that they have a gradient: each relaxation is exact at integers.

Three kinds. *Samples*: a real count spreads them, counted back from the end, so that a new sample
enters at the start with no length. *Stored nodes*: each is kept with some probability, and the mean
over all choices of nodes is flown. *Modes*: a soft cutoff at a real order. The last two have a
temperature, which falls until every node or mode is either kept or left out.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.spectral import interval, legendre_matrix, legendre_vandermonde, nodes_lg

_POINTS = 32  # of the quadrature of a density: exact to rounding for weights of a few modes


def sample_lengths(count: Any, most: int, horizon: Any, shape: Any = None) -> Float[Array, " most"]:
    r"""Lengths of up to `most` samples whose number is the real `count`: `Mission`'s
    `sample_interval`.

    With $s_j = min(j/count, 1)$, sample j from the end begins at time to go $T g(s_j)$, where g
    grows from 0 to 1. At an integer count there are as many samples of positive length. Between
    two integers the *first* sample is short. Counted from the start, $t_k = min(k \delta, t_f)$,
    the last one would be short: as continuous, but a gain to a hard end grows without bound as the
    time to go vanishes, and the objective would oscillate between any two integers.

    **Arguments:** `horizon`: T; `shape` (d,): the coefficients of order 1 ... d of the logarithm of
    g's slope in Legendre polynomials on [-1, 1], from the end to the start; None: even samples.

    **Error:** rounding, for coefficients of order one.
    """
    count = jnp.asarray(count)
    j = jnp.arange(most + 1).astype(count.dtype)
    s = jnp.minimum(j / count, 1.0)
    to_go = s if shape is None else _grown(jnp.asarray(shape), s)
    return jnp.diff(horizon * to_go)[::-1]


def _grown(shape: Float[Array, " d"], s: Float[Array, " k"]) -> Float[Array, " k"]:
    """Integral of exp(sum shape_i P_i) from 0 to s, divided by the integral from 0 to 1."""
    dtype = s.dtype
    points = jnp.asarray(nodes_lg(_POINTS)[0], dtype)
    log_slope = legendre_vandermonde(points, shape.shape[0] + 1)[:, 1:] @ shape
    a = legendre_matrix(points) @ jnp.exp(log_slope - jnp.max(log_slope))
    # int P_i = (P_{i+1} - P_{i-1})/(2 i + 1), and x + 1 for i = 0.
    P = legendre_vandermonde(2 * s - 1, _POINTS + 1)
    order = jnp.arange(1, _POINTS).astype(dtype)
    higher = (P[:, 2:] - P[:, :-2]) / (2 * order + 1)[None, :]
    integral = a[0] * 2 * s + higher @ a[1:]
    return jnp.where(s < 1, integral / (2 * a[0]), 1.0)


def cutoff(count: Any, size: int, temperature: Any) -> Float[Array, " size"]:
    r"""Weights of `size` ordered terms (Legendre modes, say) of which `count` are kept:
    $\sigma((count - k - 1/2)/temperature)$ for term k = 0, 1, ...

    As the temperature falls to 0, they become 1 for the first `count` terms, rounded, else 0.
    """
    count = jnp.asarray(count)
    k = jnp.arange(size).astype(count.dtype)
    return jax.nn.sigmoid((count - k - 0.5) / temperature)


def priced(share: Float[Array, " term"]) -> Float[Array, ""]:
    r"""The number of terms that are kept in part, as an objective should charge for them:
    $\sum_k 1 - (1 - share_k)^2$, so that a half costs three quarters.

    As a term enters, the squared error that it removes falls as $(1 - share)^2$. Charged by the
    share itself, a term would be best kept in part at any temperature. Charged so, the objective is
    linear in $(1 - share)^2$, and best where the term is kept or left out.
    """
    return jnp.sum(1 - (1 - share) ** 2)


def occupancy(logits: Float[Array, " node"], temperature: Any) -> Float[Array, " node"]:
    r"""The probability that each node is kept, $\sigma(logit/temperature)$.

    As the temperature falls to 0, it becomes 0 or 1.
    """
    return jax.nn.sigmoid(logits / temperature)


def thinned_weights(
    places: Float[Array, " node"], present: Float[Array, " node"], t: Any
) -> Float[Array, " node"]:
    """Weights of the nodes' values at `t`: the mean of linear interpolation over all choices of
    nodes, node i being kept with probability `present[i]`, independently of the others.

    The first and the last node are always kept; beyond them the nearest line is extended. Where all
    probabilities are 0 or 1 it is linear interpolation between the nodes kept; it is multilinear in
    `present`, so it has no kink in between.
    """
    n = places.shape[0]
    inner = jnp.arange(n)
    ends = (inner == 0) | (inner == n - 1)
    present = jnp.where(ends, 1.0, present)
    absent = 1 - present
    at = interval(places, t)  # the node to the left, if all were kept
    left = inner <= at.astype(inner.dtype)
    # Probability that i is the nearest node kept to the left: it is kept, none between is.
    gap_left = jnp.cumprod(jnp.where(left, absent, 1.0)[::-1])[::-1]
    gap_left = jnp.append(gap_left[1:], 1.0)
    gap_right = jnp.cumprod(jnp.where(left, 1.0, absent))
    gap_right = jnp.concatenate([jnp.ones(1, gap_right.dtype), gap_right[:-1]])
    p_left = jnp.where(left, present * gap_left, 0.0)
    p_right = jnp.where(left, 0.0, present * gap_right)
    both = p_left[:, None] * p_right[None, :]
    width = places[None, :] - places[:, None]
    share = (t - places)[:, None] / jnp.where(width > 0, width, 1.0)
    return jnp.sum(both * (1 - share), axis=1) + jnp.sum(both * share, axis=0)


def cooling(start: float, end: float, steps: int, hold: float = 0.25) -> Callable[[int], float]:
    """A temperature for each step: from `start` to `end` by a constant factor, then `end` for the
    last `hold` of the steps.

    **Raises:** `ValueError` unless 0 < end <= start and 0 <= hold < 1.
    """
    if not 0 < end <= start or not 0 <= hold < 1 or steps < 1:
        raise ValueError(
            f"cooling: start={start}, end={end}, steps={steps}, hold={hold}; need start >= end > 0,"
            " at least one step, and a hold in [0, 1)."
        )
    falling = max(int(steps * (1 - hold)), 1)
    return lambda step: start * (end / start) ** min(step / falling, 1.0)
