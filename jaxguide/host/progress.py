"""Progress of long host-side work: an object with `init`, `step`, `close`, as Diffrax's meters.

Host only: the pure functions never see it. The default everywhere is none.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """A progress meter, as long computations call it; Diffrax's meters fit it too."""

    def init(self) -> Any:
        """State of a new meter."""
        ...

    def step(self, state: Any, progress: Any) -> Any:
        """The new state, having shown `progress`, a number on [0, 1]."""
        ...

    def close(self, state: Any) -> None:
        """Ends the meter; called on failure too."""
        ...


class NoProgress:
    """A `Progress` that shows nothing."""

    def init(self) -> None:
        """State of a new meter."""
        return None

    def step(self, state: None, progress: Any) -> None:
        """The new state, having shown `progress`, a number on [0, 1]."""
        return None

    def close(self, state: None) -> None:
        """Ends the meter; called on failure too."""
        return None


class RichProgress:
    """A `Progress` as a bar on stderr, with the time elapsed and left; it pulses until the first
    `step`.

    Nothing is shown where stderr is neither a terminal nor a notebook's.

    **Arguments:**

    - `label`: the name of the work.
    - `delay`: seconds before the bar appears, so that quick work shows nothing.
    - `total`, `unit`: the amount of work, for a rate such as "490,000 flights/s".
    """

    def __init__(self, label: str, delay: float = 2.0, total: int | None = None, unit: str = ""):
        self.label, self.delay = label, delay
        self.total, self.unit = total, unit

    def init(self) -> Any:
        """State of a new meter."""
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
        from rich.progress import TimeElapsedColumn as Elapsed
        from rich.progress import TimeRemainingColumn as Left

        columns: list[Any] = [TextColumn("{task.description}"), BarColumn(), TaskProgressColumn()]
        if self.total is not None:
            columns.append(TextColumn("{task.fields[rate]}"))
        console = Console(stderr=True)
        # Without `disable` a redirected stderr would collect blank lines.
        shown = console.is_terminal or console.is_jupyter
        bar = Progress(
            *columns, Elapsed(), Left(), console=console, transient=True, disable=not shown
        )
        task = bar.add_task(self.label, total=None, rate="")
        timer = threading.Timer(self.delay, bar.start)
        timer.daemon = True
        timer.start()
        return bar, task, timer, time.perf_counter()

    def step(self, state: Any, progress: Any) -> Any:
        """The new state, having shown `progress`, a number on [0, 1]."""
        bar, task, _, began = state
        rate = ""
        if self.total is not None:
            a_second = float(progress) * self.total / max(time.perf_counter() - began, 1e-9)
            rate = f"{a_second:,.0f} {self.unit}/s"
        bar.update(task, total=1.0, completed=float(progress), rate=rate)
        return state

    def close(self, state: Any) -> None:
        """Ends the meter; called on failure too."""
        bar, _, timer, _ = state
        timer.cancel()
        timer.join()  # a bar about to start has started, so that stop ends it
        bar.stop()


class _Spoken:
    """A line on stderr that says what long work is at, from `delay` seconds on."""

    def __init__(self, label: str, delay: float):
        self.label, self.text, self.bar = label, label, None
        self.lock = threading.Lock()
        self.timer = threading.Timer(delay, self.begin)
        self.timer.daemon = True
        self.timer.start()

    def begin(self) -> None:
        """Shows the line."""
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        with self.lock:
            self.bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self.bar.add_task(self.text)
            self.bar.start()

    def say(self, text: str) -> None:
        """What the work is at now."""
        with self.lock:
            self.text = f"{self.label}: {text}"
            if self.bar is not None:
                self.bar.update(self.bar.task_ids[0], description=self.text)

    def end(self) -> None:
        """Takes the line away."""
        self.timer.cancel()
        self.timer.join()  # one about to begin has begun, so that stop ends it
        if self.bar is not None:
            self.bar.stop()


@contextmanager
def spoken(label: str, wanted: bool, delay: float = 2.0) -> Iterator[Callable[[str], None]]:
    """Gives a function that says on stderr what the block is at. Nothing is shown before `delay`
    seconds, unless `wanted`, and where stderr is neither a terminal nor a notebook's."""
    if not wanted or not (sys.stderr.isatty() or "ipykernel" in sys.modules):
        yield lambda text: None
        return
    line = _Spoken(label, delay)
    try:
        yield line.say
    finally:
        line.end()


@contextmanager
def waiting(meter: Progress | None) -> Iterator[None]:
    """Shows `meter` while the block runs, for work whose progress is unknown."""
    meter = NoProgress() if meter is None else meter
    state = meter.init()
    try:
        yield
    finally:
        meter.close(state)


def metered(items: Iterable[Any], count: int, meter: Progress | None) -> Iterator[Any]:
    """Iterates over `items`, of which there are `count`, and steps `meter` after each."""
    meter = NoProgress() if meter is None else meter
    state = meter.init()
    try:
        for done, item in enumerate(items, 1):
            yield item
            state = meter.step(state, done / count)
    finally:
        meter.close(state)
