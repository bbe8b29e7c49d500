"""Two sweeps with the same draws, case by case: what one law does better. Host only."""

import math
from typing import Any

import numpy as np

from jaxguide.montecarlo.statistics import normal_quantile, wilson_bounds
from jaxguide.types import RESULTS, code

_BLOCK = 65_536  # cases read at once


def compare(a: Any, b: Any, quantity: str = "miss", confidence: float = 0.95) -> dict[str, Any]:
    """`quantity` of the sweep `b` less that of `a`, over the cases that both brought home.

    Sweeps of one seed draw the same whatever flies them (common random numbers), so differences of
    laws are not hidden under those of cases.

    **Arguments:** `a`, `b`: Datasets of `jg.sweep`, or of stores (`xr.open_zarr`); `quantity`:
    "miss", "final_time", or a state's name, at the end.

    **Returns:** `cases`; `a`, `b`: means; `difference` with its bounds `low`, `high` from paired
    cases; `unpaired`: the half width that independent sweeps would have given; `correlation`;
    `lower`: share of cases in which b's is lower, `lower_bounds` by Wilson (equal ones count half);
    `failed_in_a_only`, `failed_in_b_only`.

    **Raises:** `ValueError` where the two did not draw the same, or keep no single cases.
    """
    cases = min(a.sizes["case"], b.sizes["case"])
    good = code(RESULTS.successful)
    drawn = sorted(str(name) for name in a.data_vars if str(name).startswith("draw:"))
    if drawn != sorted(str(name) for name in b.data_vars if str(name).startswith("draw:")):
        raise ValueError("compare: the sweeps disperse different leaves; fly both with the same.")
    counts = np.zeros(6)  # pairs, lower, equal, failed in a only, in b only, cases
    sums, squares = np.zeros(3), np.zeros((3, 3))
    origin = None
    for start in range(0, cases, _BLOCK):
        rows = slice(start, min(start + _BLOCK, cases))
        left, right = (d.isel(case=rows) for d in (a, b))
        for name in drawn:
            wrong = np.flatnonzero(
                (left[name].values != right[name].values).reshape(rows.stop - start, -1).any(axis=1)
            )
            if len(wrong):
                raise ValueError(
                    f"compare: case {start + wrong[0]} drew another {name.partition(':')[2]} in "
                    "each sweep; fly both with one seed, sampling and dtype."
                )
        sound = [d["result"].values == good for d in (left, right)]
        both = sound[0] & sound[1]
        x, y = (_values(d, quantity)[both] for d in (left, right))
        counts += [
            both.sum(), (y < x).sum(), (y == x).sum(), (~sound[0] & sound[1]).sum(),
            (sound[0] & ~sound[1]).sum(), len(both),
        ]  # fmt: skip
        if origin is None and len(x):
            origin = x[0]  # sums about a value of their own size keep their digits
        if len(x):
            table = np.stack([x - origin, y - origin, y - x])
            sums += table.sum(axis=1)
            squares += np.einsum("ik,jk->ij", table, table)
    n = int(counts[0])
    if n < 2:
        raise ValueError(f"compare: {n} cases came home in both sweeps; fly more.")
    mean = sums / n
    covariance = (squares - n * np.outer(mean, mean)) / (n - 1)
    z = normal_quantile(0.5 + confidence / 2)
    half = z * math.sqrt(max(covariance[2, 2], 0.0) / n)
    size = math.sqrt(covariance[0, 0] * covariance[1, 1])
    low, high = wilson_bounds(int(counts[1] + counts[2] / 2), n, confidence)
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
        "lower": float((counts[1] + counts[2] / 2) / n),
        "lower_bounds": (low, high),
        "failed_in_a_only": int(counts[3]),
        "failed_in_b_only": int(counts[4]),
    }


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
