"""Sums over flights from which statistics are made, the same bits whatever the chunks: moments tile
by tile, added in order, and histograms of integers. A few megabytes for any number of cases. Host
only."""

import functools
import math
from typing import Any

import numpy as np

from jaxguide.montecarlo.statistics import PERCENTILES, normal_quantile

# A histogram whose bins are the exponents and first 12 mantissa bits of a float: bins of relative
# width 2^-12 for deviations from 2^-40 to 2^24 of their scale, so that no range must be chosen.
_BITS, _LOWEST, _OCTAVES = 12, -40, 64
_SPAN = _OCTAVES << _BITS
BINS = 2 * _SPAN
_BASE = (1023 + _LOWEST) << _BITS


class Tally:
    """Statistics of `k` quantities from sums of their deviations from `centre` (k,).

    **Arguments:** `scale` (k,): rough sizes of the deviations; `moments` (tile, 1 + k + k^2) by
    `tile_moments`; `histogram` (k, BINS) by `count_in`.

    **Error:** moments to rounding; percentiles to 2^-12 of their distance from `centre`.
    """

    def __init__(
        self, centre: np.ndarray, scale: np.ndarray, moments: np.ndarray, histogram: np.ndarray
    ):
        self.centre, self.scale = np.asarray(centre, float), np.asarray(scale, float)
        self.histogram = histogram
        k = self.centre.size
        # In the order of tiles, one after another: the same bits whatever chunks they came in.
        totals = functools.reduce(np.add, moments)
        self.count = int(totals[0])
        self.sums, self.squares = totals[1 : 1 + k], totals[1 + k :].reshape(k, k)

    @property
    def mean(self) -> np.ndarray:
        """(k,); the centre without cases."""
        return self.centre + self.sums / max(self.count, 1)

    @property
    def covariance(self) -> np.ndarray:
        """(k, k), unbiased; zero below two cases."""
        if self.count < 2:
            return np.zeros_like(self.squares)
        off = self.sums / self.count
        return (self.squares - self.count * np.outer(off, off)) / (self.count - 1)

    def percentile(self, i: int, percent: float, confidence: float = 0.95) -> dict[str, float]:
        """Percentile of quantity `i`: `value`, and its bounds `low`, `high` at `confidence`.

        The bounds assume no distribution: the number of samples below a quantile is binomial, so
        they are order statistics; infinite where the sample is too small for one.

        **Source:** David & Nagaraja, Order Statistics (2003), section 7.1.
        """
        p, n = percent / 100, self.count
        cumulative = np.cumsum(self.histogram[i])
        spread = normal_quantile(0.5 + confidence / 2) * math.sqrt(n * p * (1 - p))
        low, high = math.floor(n * p - spread) - 1, math.ceil(n * p + spread)
        at = lambda rank: float(self.centre[i] + self.scale[i] * _order_statistic(cumulative, rank))
        below = math.floor(p * (n - 1))
        share = p * (n - 1) - below
        return {
            "value": (1 - share) * at(below) + share * at(min(below + 1, n - 1)),
            "low": at(low) if low >= 0 else -math.inf,
            "high": at(high) if high < n else math.inf,
        }

    def summary(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Mean, standard deviation and percentiles of each quantity."""
        if not self.count:
            return {}
        std = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {
            name: {
                "mean": float(self.mean[i]),
                "std": float(std[i]),
                **{f"p{p:g}": self.percentile(i, p) for p in PERCENTILES},
            }
            for i, name in enumerate(names)
        }


def tile_moments(deviations: np.ndarray) -> np.ndarray:
    """(1 + k + k^2,): count, sums and summed products of the rows (cases, k).

    By loops of one fixed order, not by BLAS, whose order depends on its threads.
    """
    products = np.einsum("ij,ik->jk", deviations, deviations)
    return np.concatenate([[len(deviations)], deviations.sum(axis=0), products.ravel()])


def count_in(histogram: np.ndarray, deviations: np.ndarray) -> None:
    """Counts each column of `deviations` (cases, k), in units of its scale, in its row of
    `histogram` (k, BINS), in place."""
    bits = np.ascontiguousarray(deviations.T).view(np.int64)
    key = np.clip(((bits & (2**63 - 1)) >> (52 - _BITS)) - _BASE, 0, _SPAN - 1)
    key = np.where(bits < 0, _SPAN - 1 - key, _SPAN + key)
    for row, keys in zip(histogram, key, strict=True):
        np.add.at(row, keys, 1)


def packed(histogram: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices and counts of the bins that are not empty: at most a tenth of the bytes to send."""
    at = np.flatnonzero(histogram)
    return at.astype(np.int32), histogram.ravel()[at].astype(np.int32)


def unpacked(packet: Any, quantities: int) -> np.ndarray:
    """The histogram (quantities, BINS) from the indices and counts of `packed`."""
    at, counts = packet
    histogram = np.zeros(quantities * BINS, np.int64)
    histogram[at] = counts
    return histogram.reshape(quantities, BINS)


def edges_of_bins() -> np.ndarray:
    """(BINS + 1,): the edges of the bins of a histogram, in units of the scale."""
    positive = _edge(np.arange(_SPAN + 1))
    return np.concatenate([-positive[::-1], positive[1:]])


def _edge(key: Any) -> Any:
    """Lower end of the bin `key` of positive numbers."""
    return ((np.asarray(key, np.int64) + _BASE) << (52 - _BITS)).view(float)


def _order_statistic(cumulative: np.ndarray, rank: int) -> float:
    """The `rank`-th value, from 0, taking values as evenly spread within a bin."""
    i = int(np.searchsorted(cumulative, rank, side="right"))
    i = min(i, BINS - 1)
    before = cumulative[i - 1] if i else 0
    share = (rank - before + 0.5) / max(cumulative[i] - before, 1)
    if i >= _SPAN:
        a, b = _edge(i - _SPAN), _edge(i - _SPAN + 1)
    else:
        a, b = -_edge(_SPAN - i), -_edge(_SPAN - 1 - i)
    return float(a + share * (b - a))
