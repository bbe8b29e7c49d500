"""The share of each outcome's variance that each dispersed number explains by itself. Host only.

First-order Sobol indices: S_i = Var(E[y | x_i]) / Var(y) (Saltelli et al., Sensitivity Analysis
(2000)). From flights, by the means of y over bins of x_i; to first order, from the parts of the
linear covariance.
"""

import math
from typing import Any

import numpy as np

TILES = 64  # whose cases are used: with tiles of 4,096, shares have 95 % bounds of 0.4 %
SLOTS = 64  # bins of equal probability; a straight line loses 0.6 % of its variance within them
# Deviations are rounded to integers, a millionth of their scale each, so that sums do not depend
# on their order; beyond 2^11 scales they are cut off, so that sums of 2^22 cases are exact.
_UNIT = 2.0**20
_FAR = 2.0**31


def edges_of(draws: np.ndarray) -> np.ndarray:
    """Bin edges (d, SLOTS - 1) from a sample (cases, d) of the draws."""
    at = np.arange(1, SLOTS) / SLOTS
    return np.quantile(np.asarray(draws, float), at, axis=0).T


def bin_sums(draws: np.ndarray, deviations: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(d, SLOTS, 1 + k) integers: for each bin, its number of cases and their summed deviations.

    `draws` (cases, d); `deviations` (cases, k) in units of their scale, those beyond 2^11 cut off.
    """
    whole = np.rint(np.clip(deviations * _UNIT, -_FAR, _FAR))
    sums = np.empty((len(edges), SLOTS, 1 + whole.shape[1]), np.int64)
    for row, edge, x in zip(sums, edges, draws.T, strict=True):
        slot = np.searchsorted(edge, x, side="right")
        row[:, 0] = np.bincount(slot, minlength=SLOTS)
        for j, y in enumerate(whole.T):  # sums of integers below 2^53: exact
            row[:, 1 + j] = np.bincount(slot, y, minlength=SLOTS)
    return sums


def first_order(sums: np.ndarray, variance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(d, k, 2): first-order indices and the half width of their 95 % bounds.

    **Arguments:** `sums` of `bin_sums`; `variance`, `scale` (k,) of the outcomes.

    **Error:** the part of the bin means' variance that is due to chance is subtracted (omega
    squared); the bounds assume normal outcomes (Olkin & Finn, Psychological Bulletin 118 (1995)).
    Below some thousands of cases they are wide.
    """
    count = sums[..., 0].astype(float)
    total = count.sum(axis=1)
    out = np.full((len(sums), len(scale), 2), np.nan)
    for i in range(len(sums)):
        n, used = total[i], count[i] > 0
        groups = int(used.sum())
        if n <= groups or groups < 2:
            continue
        means = sums[i, used, 1:] / count[i, used, None]
        middle = sums[i, :, 1:].sum(axis=0) / n
        between = (count[i, used, None] * (means - middle) ** 2).sum(axis=0)
        whole = (n - 1) * variance * (_UNIT / scale) ** 2
        within = np.maximum(whole - between, 0.0) / (n - groups)
        share = (between - (groups - 1) * within) / np.where(whole > 0, whole + within, np.nan)
        spread = 4 * share.clip(0) * (1 - share) ** 2 / n + 2 * (groups - 1) / n**2
        out[i, :, 0], out[i, :, 1] = share, 1.96 * np.sqrt(spread)
    return out


def linear_shares(parts: np.ndarray) -> np.ndarray:
    """(part, k): each part's share of the linear variance."""
    each = np.einsum("pkk->pk", parts)
    total = each.sum(axis=0)
    return np.divide(each, total, out=np.full_like(each, math.nan), where=total > 0)


def by_outcome(
    names: tuple[str, ...], outcomes: tuple[str, ...], values: np.ndarray
) -> dict[str, Any]:
    """`values` (name, outcome, ...) as dictionaries: outcome -> name -> value."""
    return {
        outcome: {name: values[i, j].tolist() for i, name in enumerate(names)}
        for j, outcome in enumerate(outcomes)
    }
