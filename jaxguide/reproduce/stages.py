"""The stages of a reproduction, named, timed and shown."""

import contextlib
import time
from collections.abc import Iterator

from jaxguide.host.progress import Progress
from jaxguide.reproduce.report import Report


class Stages:
    """Names, times and shows the stages of a reproduction.

    **Arguments:** `report`: its `timings` are filled in; `progress`: shows the share done;
    `count`: number of stages.
    """

    def __init__(self, report: Report, progress: Progress, count: int):
        self.report, self.progress, self.count, self.done = report, progress, count, 0
        self.state = progress.init()

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """One stage: a context that times its body."""
        began = time.perf_counter()
        yield
        self.report.timings[name] = time.perf_counter() - began
        self.done += 1
        self.state = self.progress.step(self.state, self.done / self.count)

    def close(self) -> None:
        """Ends the display."""
        self.progress.close(self.state)
