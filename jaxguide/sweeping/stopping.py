"""Rules that stop a sweep once its statistics are good enough.

A rule looks at the statistics after every `LOOK` tiles, in the order of cases, in whatever order
they were flown; chunks divide that number. So a stopped sweep has the same bits on any chunks,
devices and workers.
"""

import abc
from typing import Any

import equinox as eqx

from jaxguide.montecarlo.statistics import wilson_bounds
from jaxguide.sweeping.tally import Tally
from jaxguide.types import RESULTS, code

LOOK = 16  # tiles between two looks; a power of two, so that chunks of 1, 2, 4 ... tiles divide it


class Stop(eqx.Module):
    """Abstract: decides whether the statistics of the cases flown are good enough to stop."""

    @abc.abstractmethod
    def enough(self, tally: Tally, names: tuple[str, ...], codes: Any) -> bool:
        """Whether to stop.

        **Arguments:** `tally`: statistics of the successful cases; `names`: its quantities; `codes`
        (result,): number of cases by result code.
        """

    @abc.abstractmethod
    def check(self, names: tuple[str, ...]) -> None:
        """Checks the rule before a sweep with the quantities `names`.

        **Raises:** `ValueError` if the rule is about another quantity.
        """


class SuccessWithin(Stop):
    """Enough when the Wilson bounds of the success rate lie at most `width` apart.

    **Arguments:** `width`: in (0, 1); `confidence`: of the bounds at each look. The rule stops
    at the first look with narrow bounds, which may hold a little less often than those of one look.
    """

    width: float | int = eqx.field(static=True)
    confidence: float = eqx.field(static=True, default=0.95)

    def __check_init__(self):
        _positive("SuccessWithin", self.width, self.confidence)

    def enough(self, tally: Tally, names: tuple[str, ...], codes: Any) -> bool:
        good, count = int(codes[code(RESULTS.successful)]), int(codes.sum())
        low, high = wilson_bounds(good, count, self.confidence)
        return high - low <= self.width

    def check(self, names: tuple[str, ...]) -> None:
        pass


class PercentileWithin(Stop):
    """Enough when the bounds of a percentile of `quantity` lie at most `width` apart.

    **Arguments:** `quantity`: a state, or "miss"; `percent`: on (0, 100); `width`: in its own
    units; `confidence` of the bounds.
    """

    quantity: str = eqx.field(static=True)
    percent: float | int = eqx.field(static=True)
    width: float | int = eqx.field(static=True)
    confidence: float = eqx.field(static=True, default=0.95)

    def __check_init__(self):
        _positive("PercentileWithin", self.width, self.confidence)
        if not 0 < self.percent < 100:
            raise ValueError(
                f"PercentileWithin: percent is {self.percent}; give 0 < percent < 100."
            )

    def enough(self, tally: Tally, names: tuple[str, ...], codes: Any) -> bool:
        if tally.count < 2:
            return False
        bounds = tally.percentile(names.index(self.quantity), self.percent, self.confidence)
        return bounds["high"] - bounds["low"] <= self.width

    def check(self, names: tuple[str, ...]) -> None:
        if self.quantity not in names:
            raise ValueError(
                f"PercentileWithin: no quantity {self.quantity!r}; there are {', '.join(names)}."
            )


def rule(text: str) -> Stop:
    """The rule that `text` describes: "success:WIDTH", or "QUANTITY:PERCENT:WIDTH", such as
    "miss:99:1e-6".

    **Raises:** `ValueError` for another form.
    """
    parts = text.split(":")
    try:
        if parts[0] == "success" and len(parts) == 2:
            return SuccessWithin(float(parts[1]))
        if len(parts) == 3:
            return PercentileWithin(parts[0], float(parts[1]), float(parts[2]))
    except ValueError as e:
        raise ValueError(f"stop is {text!r}: {e}") from e
    raise ValueError(f'stop is {text!r}; give "success:0.001" or "miss:99:1e-6", say.')


def _positive(rule: str, width: float | int, confidence: float) -> None:
    if not width > 0:
        raise ValueError(f"{rule}: width is {width}; give a number > 0.")
    if not 0 < confidence < 1:
        raise ValueError(f"{rule}: confidence is {confidence}; give one on (0, 1), such as 0.95.")


def fitting(each: int) -> int:
    """`each` tiles a chunk, rounded up to a divisor of `LOOK`."""
    return min(1 << (each - 1).bit_length(), LOOK)
