"""The worst of many cases, kept while they stream by. Host only."""

from typing import Any

import numpy as np

WORST = 20  # cases that are remembered


def worst(measure: np.ndarray, first: int, result: np.ndarray) -> np.ndarray:
    """(WORST, 3): measure, case number and result of those of largest `measure`, the largest
    first; equal ones by their number. `first`: number of the first case. Rows of -1 fill up."""
    measure = np.where(np.isfinite(measure), measure, -1.0)
    if len(measure) > WORST:
        least = np.partition(measure, -WORST)[-WORST]
        at = np.flatnonzero(measure >= least)
    else:
        at = np.arange(len(measure))
    return merged(np.column_stack([measure[at], first + at, result[at]]).astype(float))


def merged(*tables: np.ndarray) -> np.ndarray:
    """The worst of several tables: the same whatever their order."""
    rows = np.concatenate([np.full((WORST, 3), -1.0), *tables])
    order = np.lexsort((rows[:, 1], -rows[:, 0]))[:WORST]
    # A filler may stand before a case without a measure: both say nothing.
    return np.where(rows[order, :1] < 0, -1.0, rows[order])


def told(table: np.ndarray, name: Any) -> list[dict[str, Any]]:
    """As dictionaries; `name` gives a result's name."""
    return [
        {"case": int(case), "measure": float(value), "result": name(int(result))}
        for value, case, result in table
        if value >= 0
    ]
