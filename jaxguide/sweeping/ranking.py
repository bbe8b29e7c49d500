"""The worst of many cases, kept while they stream by. Host only."""

from typing import Any

import numpy as np

WORST = 20  # cases that are kept: twice as many as a report shows


def worst(measure: np.ndarray, first: int, result: np.ndarray) -> np.ndarray:
    """(WORST, 3): measure, case number and result of the cases of largest `measure`.

    The largest comes first, equal ones in the order of their numbers; rows of -1 fill the table up.

    **Arguments:** `measure` (cases,); `first`: number of the first case; `result` (cases,): codes.
    """
    measure = np.where(np.isfinite(measure), measure, -1.0)
    if len(measure) > WORST:
        least = np.partition(measure, -WORST)[-WORST]
        at = np.flatnonzero(measure >= least)
    else:
        at = np.arange(len(measure))
    return merged(np.column_stack([measure[at], first + at, result[at]]).astype(float))


def merged(*tables: np.ndarray) -> np.ndarray:
    """The worst cases of several tables of `worst`, (WORST, 3); does not depend on their order."""
    rows = np.concatenate([np.full((WORST, 3), -1.0), *tables])
    order = np.lexsort((rows[:, 1], -rows[:, 0]))[:WORST]
    # A case without a finite measure has -1 too, and is not ranked.
    return np.where(rows[order, :1] < 0, -1.0, rows[order])


def as_records(table: np.ndarray, name: Any) -> list[dict[str, Any]]:
    """The rows of `table` as dictionaries; `name(code)` is the name of a result."""
    return [
        {"case": int(case), "measure": float(value), "result": name(int(result))}
        for value, case, result in table
        if value >= 0
    ]
