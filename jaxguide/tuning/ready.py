"""A design ready to tune: what `jg.tune` needs, and how its result is confirmed."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxguide.tuning.loop import tune
from jaxguide.tuning.record import Tuned


class Ready(NamedTuple):
    """A named design.

    - `objective`, `design`, `build`, `optimizer`, `temperature`: as `jg.tune` takes them.
    - `steps`, `cases`: what its author found enough. Without dispersions `cases` is 1.
    - `confirm(tuned, cases, seed)`: rows of a table (name -> start, tuned) with true integers on
      fresh cases, and `notes` on what was found.
    - `places(design)`: name -> places on a line, from 0 to 1, to draw before and after.
    - `rounded(tuned)`: the design with its count made an integer, to tune what is left; None where
      there is nothing to round.
    """

    name: str
    about: str
    objective: Callable[..., Any]
    design: Any
    build: Callable[..., Any]
    optimizer: Any
    steps: int
    cases: int
    confirm: Callable[[Tuned, int, int], "Confirmed"]
    places: Callable[[Any], dict[str, Any]]
    temperature: Callable[[int], float] | None = None
    compiler_options: dict[str, Any] | None = None
    rounded: Callable[[Tuned], "Ready"] | None = None

    def tune(
        self,
        steps: int | None = None,
        cases: int | None = None,
        seed: int = 0,
        **options: Any,
    ) -> Tuned:
        """Tunes it, as it is: relaxed, if it is; `options` as for `jg.tune`."""
        given: dict[str, Any] = {
            "steps": self.steps if steps is None else steps,
            "cases": self.cases if cases is None else cases,
            "temperature": self.temperature,
            "compiler_options": self.compiler_options,
        }
        return tune(
            self.objective, self.design, self.build, self.optimizer,
            **{**given, "seed": seed, **options},
        )  # fmt: skip


class Confirmed(NamedTuple):
    """Before and after, on true integers and fresh cases.

    `rows`: what -> (start, tuned); `beside`: of a count, integer -> true objective; `notes`: in
    words. `better`: whether the tuned design does what it was tuned for.
    """

    rows: dict[str, tuple[float, float]]
    beside: dict[int, float]
    notes: tuple[str, ...]
    better: bool
