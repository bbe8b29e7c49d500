"""Statistics of a sweep: moments, percentiles with their confidence bounds, success rate."""

import math
from typing import Any

import numpy as np

PERCENTILES = (1.0, 5.0, 50.0, 95.0, 99.0)


def percentile_bounds(values: np.ndarray, percent: float, confidence: float = 0.95) -> dict:
    """A percentile and its distribution-free confidence bounds, from order statistics.

    The number of samples below the p-quantile is binomial(N, p); its normal approximation gives
    the ranks of the bounds.
    """
    ordered = np.sort(values)
    count, p = ordered.size, percent / 100
    z = normal_quantile(0.5 + confidence / 2)
    spread = z * math.sqrt(count * p * (1 - p))
    low, high = math.floor(count * p - spread) - 1, math.ceil(count * p + spread)
    bound = lambda rank, beyond: float(ordered[rank]) if 0 <= rank < count else beyond
    value = float(np.quantile(ordered, p))
    return {"value": value, "low": bound(low, -math.inf), "high": bound(high, math.inf)}


def wilson_bounds(successes: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score bounds of a success rate."""
    if count == 0:
        return 0.0, 1.0
    z = normal_quantile(0.5 + confidence / 2)
    rate = successes / count
    centre = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count**2)) / (1 + z * z / count)
    return max(0.0, centre - half), min(1.0, centre + half)


def summarise(values: np.ndarray, names: tuple[str, ...]) -> dict[str, Any]:
    """Mean, standard deviation and percentiles of each column of `values` (cases, k)."""
    summary: dict[str, Any] = {}
    for i, name in enumerate(names):
        column = values[:, i]
        if column.size == 0:
            continue
        summary[name] = {
            "mean": float(column.mean()),
            "std": float(column.std(ddof=1)) if column.size > 1 else 0.0,
            **{f"p{p:g}": percentile_bounds(column, p) for p in PERCENTILES},
        }
    return summary


def normal_quantile(p: float) -> float:
    from statistics import NormalDist

    return NormalDist().inv_cdf(p)
