"""A design ready to tune: what `jg.tune` needs, and how its result is confirmed."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxguide.tuning.loop import tune
from jaxguide.tuning.record import Tuned


class Ready(NamedTuple):
    """A named design with all that `jg.tune` needs.

    - `objective`, `design`, `build`, `optimizer`, `temperature`: as `jg.tune` takes them.
    - `about`: what is tuned, in a line.
    - `steps`, `cases`: enough by experiment on this design. Without dispersions `cases` is 1.
    - `confirm(tuned, cases, seed)`: the start and the tuned design compared with true integers on
      fresh cases.
    - `places(design)`: name -> numbers from 0 to 1, drawn on a line before and after tuning.
    - `rounded(tuned)`: the design with its count fixed at an integer, whose other leaves are tuned
      next; None if there is no count.
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
        """Tunes the design; its counts stay relaxed. `options`: as for `jg.tune`."""
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

    `rows`: name of a quantity -> its value at (start, tuned); `beside`: for a count, integer ->
    true objective; `notes`: sentences. `better`: whether the tuned design is better than the start.
    """

    rows: dict[str, tuple[float, float]]
    beside: dict[int, float]
    notes: tuple[str, ...]
    better: bool
