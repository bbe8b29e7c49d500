"""What statistics of a sweep share: quantiles, and the bounds of a success rate."""

import math
from statistics import NormalDist

PERCENTILES = (1.0, 5.0, 50.0, 95.0, 99.0)


def wilson_bounds(successes: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score bounds of a success rate."""
    if count == 0:
        return 0.0, 1.0
    z = normal_quantile(0.5 + confidence / 2)
    rate = successes / count
    centre = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count**2)) / (1 + z * z / count)
    # At the edges the bounds are 0 and 1 but for rounding.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    return low, 1.0 if successes == count else min(1.0, centre + half)


def normal_quantile(p: float) -> float:
    """Of the standard normal distribution."""
    return NormalDist().inv_cdf(p)
