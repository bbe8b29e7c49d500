"""The chunks of a sweep flown, kept and added up, until all are done or a rule stops them. Host
only."""

import time
from collections.abc import Generator, Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxguide.host.cores import over_cores
from jaxguide.host.progress import NoProgress
from jaxguide.sweeping.cluster import over_workers
from jaxguide.sweeping.keeping import AbstractStore
from jaxguide.sweeping.stopping import LOOK, Stop
from jaxguide.sweeping.tally import Tally
from jaxguide.sweeping.tiles import Tiles
from jaxguide.sweeping.totals import Totals

Chunk = tuple[int, dict, dict]  # number, rows and sums


class SweepPlan(NamedTuple):
    """How a sweep is flown: `each` tiles a chunk, the variables `kept` of a case, the store that
    keeps them, the rule that may stop it, and the address of a Dask scheduler."""

    tiles: Tiles
    store: AbstractStore
    each: int
    kept: tuple[str, ...]
    stop: Stop | None
    scheduler: str | None

    @property
    def count(self) -> int:
        """Number of chunks."""
        return -(-self.tiles.count // self.each)

    def tiles_of(self, k: int) -> range:
        """Numbers of the tiles of chunk `k`."""
        return range(k * self.each, min((k + 1) * self.each, self.tiles.count))


class Flights(NamedTuple):
    """`totals` of all chunks; `ended`: cases up to the last chunk; `flown`: cases flown in this
    run, in `seconds`."""

    totals: dict[str, np.ndarray]
    ended: int
    flown: int
    seconds: float


def fly_chunks(plan: SweepPlan, missing: list[int], progress: Any) -> Flights:
    """Flies the chunks `missing` and keeps them; adds up the sums of all chunks.

    A rule looks at the totals after every `LOOK` tiles, in the order of cases.
    """
    order, began = plan.tiles.order, time.perf_counter()
    meter = NoProgress() if progress is None else progress
    state, totals = meter.init(), Totals()
    coming = _coming(plan, missing)
    # A rule needs the chunks in order; without one they are taken as they come.
    coming = coming if plan.stop is None else _in_order(coming, missing)
    waiting, flown, ended = set(missing), 0, order.cases
    expected = max(min(order.cases, len(missing) * plan.each * order.tile), 1)
    try:
        for i in range(plan.count):
            k, rows, sums = next(coming) if i in waiting else (i, None, plan.store.sums(i))
            totals.add(k, sums)
            if rows is not None:
                plan.store.write(k, {name: rows[name] for name in plan.kept}, sums)
                flown += len(rows["result"])
                state = meter.step(state, flown / expected)
            if _enough(plan, i, totals):
                ended = min((i + 1) * plan.each * order.tile, order.cases)
                break
    finally:
        coming.close()
        meter.close(state)
    return Flights(totals.all(), ended, flown, time.perf_counter() - began)


def _enough(plan: SweepPlan, last: int, totals: Totals) -> bool:
    """Whether the rule, if it looks after chunk `last`, stops the sweep there."""
    if plan.stop is None or (last + 1) * plan.each % LOOK:
        return False
    sums = totals.all()
    return plan.stop.enough(tally_of(plan.tiles, sums), plan.tiles.names, sums["codes"])


def tally_of(tiles: Tiles, totals: dict[str, np.ndarray]) -> Tally:
    """Statistics of the quantities of `tiles` from the totals of chunks."""
    return Tally(*tiles.reference, totals["moments"], totals["histogram"])


def _coming(plan: SweepPlan, missing: list[int]) -> Generator[Chunk]:
    """The chunks `missing`, flown here or by the workers of a cluster."""
    tiles, each = plan.tiles, plan.each
    if plan.scheduler is not None:
        chunks = {k: plan.tiles_of(k) for k in missing}
        names, scheduler = tiles.names, plan.scheduler
        yield from over_workers(tiles.order, chunks, each, plan.kept, len(names), scheduler)
        return
    parts = over_cores(tiles.fly, (i for k in missing for i in plan.tiles_of(k)))
    for k in missing:
        rows, sums = tiles.chunk([next(parts) for _ in plan.tiles_of(k)], k * each, each)
        yield k, rows, sums


def _in_order(coming: Iterator[Chunk], missing: list[int]) -> Generator[Chunk]:
    """The same chunks in the order of `missing`; those that come early wait."""
    early: dict[int, Chunk] = {}
    for k in missing:
        while k not in early:
            chunk = next(coming)
            early[chunk[0]] = chunk
        yield early.pop(k)
