"""Two sweeps with the same draws compared case by case. Host only."""

import math
from typing import Any

import numpy as np

from jaxguide.montecarlo.statistics import normal_quantile, wilson_bounds
from jaxguide.types import RESULTS, code

_BLOCK = 65_536  # cases read at once: some megabytes


class _Pairs:
    """Sums over pairs of cases, a block at a time."""

    def __init__(self):
        # Pairs, b lower, equal, failed in a only, failed in b only.
        self.counts = np.zeros(5)
        self.origin: Any = None
        self.sums, self.squares = np.zeros(3), np.zeros((3, 3))  # of a, b, b - a

    def add(self, left: Any, right: Any, quantity: str) -> None:
        """Adds a block of cases of both Datasets."""
        good = code(RESULTS.successful)
        sound = [data["result"].values == good for data in (left, right)]
        both = sound[0] & sound[1]
        x, y = (_values(data, quantity)[both] for data in (left, right))
        self.counts += [
            both.sum(), (y < x).sum(), (y == x).sum(), (~sound[0] & sound[1]).sum(),
            (sound[0] & ~sound[1]).sum(),
        ]  # fmt: skip
        if not len(x):
            return
        if self.origin is None:
            self.origin = x[0]  # sums about a value of their own size lose no digits
        table = np.stack([x - self.origin, y - self.origin, y - x])
        self.sums += table.sum(axis=1)
        self.squares += np.einsum("ik,jk->ij", table, table)

    def moments(self) -> tuple[int, np.ndarray, np.ndarray]:
        """Number of pairs, means (3,) about the origin and covariance (3, 3) of a, b, b - a.

        **Raises:** `ValueError` for fewer than two pairs.
        """
        n = int(self.counts[0])
        if n < 2:
            raise ValueError(f"compare: {n} cases came home in both sweeps; fly more.")
        mean = self.sums / n
        return n, mean, (self.squares - n * np.outer(mean, mean)) / (n - 1)


def compare(a: Any, b: Any, quantity: str = "miss", confidence: float = 0.95) -> dict[str, Any]:
    """`quantity` of the sweep `b` minus that of `a`, over the cases that succeeded in both.

    Sweeps of one seed draw the same deviations (common random numbers), so the scatter of the cases
    does not hide a difference between two laws.

    **Arguments:** `a`, `b`: Datasets of `jg.sweep`, or of stores (`xr.open_zarr`); `quantity`:
    "miss", "final_time", or a state's name, at the end.

    **Returns:** `cases`; `a`, `b`: means; `difference` with its bounds `low`, `high` from paired
    cases; `unpaired`: the half width that independent sweeps would have given; `correlation`;
    `lower`: share of cases in which b is lower, equal ones counted half, `lower_bounds` by Wilson;
    `failed_in_a_only`, `failed_in_b_only`.

    **Raises:** `ValueError` if the two did not draw the same, or do not keep single cases.
    """
    drawn = _same_leaves(a, b)
    cases = min(a.sizes["case"], b.sizes["case"])
    pairs = _Pairs()
    for start in range(0, cases, _BLOCK):
        block = slice(start, min(start + _BLOCK, cases))
        left, right = (data.isel(case=block) for data in (a, b))
        _check_draws(left, right, drawn, start)
        pairs.add(left, right, quantity)
    n, mean, covariance = pairs.moments()
    origin = pairs.origin
    _, below, equal, failed_in_a, failed_in_b = pairs.counts
    z = normal_quantile(0.5 + confidence / 2)
    half = z * math.sqrt(max(covariance[2, 2], 0.0) / n)
    size = math.sqrt(covariance[0, 0] * covariance[1, 1])
    return {
        "quantity": quantity,
        "cases": n,
        "a": float(mean[0] + origin),
        "b": float(mean[1] + origin),
        "difference": float(mean[2]),
        "low": float(mean[2] - half),
        "high": float(mean[2] + half),
        "unpaired": float(z * math.sqrt((covariance[0, 0] + covariance[1, 1]) / n)),
        "correlation": float(covariance[0, 1] / size) if size > 0 else math.nan,
        "lower": float((below + equal / 2) / n),
        "lower_bounds": wilson_bounds(int(below + equal / 2), n, confidence),
        "failed_in_a_only": int(failed_in_a),
        "failed_in_b_only": int(failed_in_b),
    }


def _same_leaves(a: Any, b: Any) -> list[str]:
    """The names of the draws, if both sweeps have the same."""
    of = lambda data: sorted(str(n) for n in data.data_vars if str(n).startswith("draw:"))
    if of(a) != of(b):
        raise ValueError("compare: the sweeps disperse different leaves; fly both with the same.")
    return of(a)


def _check_draws(left: Any, right: Any, drawn: list[str], start: int) -> None:
    """Raises `ValueError` for a case of the block from `start` that drew another number in each."""
    for name in drawn:
        differ = left[name].values != right[name].values
        wrong = np.flatnonzero(differ.reshape(len(differ), -1).any(axis=1))
        if len(wrong):
            raise ValueError(
                f"compare: case {start + wrong[0]} drew another {name.partition(':')[2]} in "
                "each sweep; fly both with one seed, sampling and dtype."
            )


def _values(data: Any, quantity: str) -> np.ndarray:
    if quantity in ("miss", "final_time") and quantity in data:
        return data[quantity].values.astype(float)
    states = [str(s) for s in data["state"].values] if "state" in data.coords else []
    if "final_state" in data and quantity in states:
        return data["final_state"].values[:, states.index(quantity)].astype(float)
    there = [q for q in ("miss", "final_time") if q in data]
    there += states if "final_state" in data else []
    raise ValueError(
        f"compare: no {quantity!r} is kept of each case; there are {', '.join(there) or 'none'}"
        '. Sweep with keep="all".'
    )
