"""Progress of long host-side work: an object with `init`, `step`, `close`, as Diffrax's meters.

Host-only: the pure functions never see it. The default everywhere is none.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """What a long computation calls. Diffrax's progress meters fit it too."""

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
    """Shows nothing."""

    def init(self) -> None:
        return None

    def step(self, state: None, progress: Any) -> None:
        return None

    def close(self, state: None) -> None:
        return None


class RichProgress:
    """A bar on stderr with the time elapsed; it pulses until the first `step`.

    Nothing is shown where stderr is not a terminal.

    **Arguments:**

    - `label`: what is being done.
    - `delay`: seconds before it appears, so that quick work shows nothing.
    """

    def __init__(self, label: str, delay: float = 2.0):
        self.label = label
        self.delay = delay

    def init(self) -> Any:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
        from rich.progress import TimeElapsedColumn as Elapsed

        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), Elapsed())
        console = Console(stderr=True)
        # Without `disable` a redirected stderr would collect blank lines.
        bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        task = bar.add_task(self.label, total=None)
        timer = threading.Timer(self.delay, bar.start)
        timer.daemon = True
        timer.start()
        return bar, task, timer

    def step(self, state: Any, progress: Any) -> Any:
        bar, task, _ = state
        bar.update(task, total=1.0, completed=float(progress))
        return state

    def close(self, state: Any) -> None:
        bar, _, timer = state
        timer.cancel()
        timer.join()  # a bar about to start has started, so that stop ends it
        bar.stop()


@contextmanager
def waiting(meter: Progress | None) -> Iterator[None]:
    """Shows `meter` while the block runs, for work that cannot say how far it is."""
    meter = NoProgress() if meter is None else meter
    state = meter.init()
    try:
        yield
    finally:
        meter.close(state)
