"""Normal quantiles, and confidence bounds of a success rate. Host only."""

import math
from statistics import NormalDist

PERCENTILES = (1.0, 5.0, 50.0, 95.0, 99.0)  # that every sweep reports


def wilson_bounds(successes: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score bounds (low, high) of a success rate; (0, 1) without cases.

    **Source:** Newcombe, Statistics in Medicine 17 (1998), method 3.
    """
    if count == 0:
        return 0.0, 1.0
    z = normal_quantile(0.5 + confidence / 2)
    rate = successes / count
    centre = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count**2)) / (1 + z * z / count)
    # With no success the lower bound is 0, with no failure the upper 1, up to rounding.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    return low, 1.0 if successes == count else min(1.0, centre + half)


def normal_quantile(p: float) -> float:
    """Quantile of the standard normal distribution, 0 < p < 1."""
    return NormalDist().inv_cdf(p)
