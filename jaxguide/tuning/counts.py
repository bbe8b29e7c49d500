"""A relaxed count rounded to an integer, and the true objective there and at its neighbours. Host
only."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np


class Count(NamedTuple):
    """A count found by gradient, checked at true integers.

    `relaxed`, `relaxed_loss`: the real count and its objective, as tuned. `count`, `loss`: the best
    integer, and the true objective there. `beside`: integer -> true objective, of the rounded count
    and of those next to it.
    """

    relaxed: float
    relaxed_loss: float
    count: int
    loss: float
    beside: dict[int, float]

    def __str__(self) -> str:
        rows = [f"relaxed {self.relaxed:.4g}: {self.relaxed_loss:.6g}"]
        rows += [f"{n}: {v:.6g}" + " <" * (n == self.count) for n, v in self.beside.items()]
        return "; ".join(rows)


def counted(
    true: Callable[[int], Any],
    relaxed: Any,
    relaxed_loss: Any,
    least: int = 1,
    most: int | None = None,
) -> Count:
    """Rounds a relaxed count and compares it with one more and one less.

    **Arguments:** `true(n)`: the objective with the integer n, without any relaxation; `least`,
    `most`: the smallest and the largest integer allowed.

    **Returns:** a Count: the best of the rounded integer and its two neighbours.

    **Raises:** `ValueError` for a count outside `least` ... `most`, or if no objective is finite.
    """
    at = round(float(relaxed))
    if at < least or (most is not None and at > most):
        raise ValueError(f"counted: {relaxed} rounds to {at}, outside {least} ... {most}.")
    near = [n for n in (at - 1, at, at + 1) if n >= least and (most is None or n <= most)]
    beside = exhaustive(true, near)
    best = min(beside, key=lambda n: beside[n])
    return Count(float(relaxed), float(relaxed_loss), best, beside[best], beside)


def exhaustive(true: Callable[[int], Any], counts: Iterable[int]) -> dict[int, float]:
    """The true objective of every count; one that is not finite is set to infinity.

    **Raises:** `ValueError` if none is finite.
    """
    found = {n: float(true(n)) for n in counts}
    found = {n: v if np.isfinite(v) else np.inf for n, v in found.items()}
    if not found or not np.isfinite(min(found.values())):
        raise ValueError(f"no count of {list(found)} has a finite objective.")
    return found
