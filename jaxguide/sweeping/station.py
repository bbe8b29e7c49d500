"""An order of flights at every worker of a Dask cluster. Host only; needs Dask to be imported."""

import contextlib
import functools
import uuid
from collections.abc import Iterator

import jax
from dask.distributed import Client, WorkerPlugin, get_worker

from jaxguide.host import flags
from jaxguide.host.cores import over_cores
from jaxguide.sweeping.tally import packed
from jaxguide.sweeping.tiles import Order, Tiles


class Station(WorkerPlugin):
    """Holds `order` in a worker. A plugin, not scattered data, which dies with those who hold it:
    the scheduler hands a plugin to workers that join later or start again, too."""

    def __init__(self, order: Order, x64: bool, options: str):
        self.order, self.x64, self.options = order, x64, options

    @functools.cached_property
    def tiles(self) -> Tiles:
        # The client's options, or bits would not be those of a flight beside it. A worker starts
        # JAX with its first order.
        if not _started:
            flags.take(self.options)
            _started.append(self.options)
        if _started[0] != self.options:
            raise RuntimeError(
                f"this worker runs XLA with {_started[0]!r}, but the sweep asks for "
                f"{self.options!r}; restart the workers, or set XLA_FLAGS to the same everywhere."
            )
        jax.config.update("jax_enable_x64", self.x64)
        return Tiles(self.order)


_started: list[str] = []  # this process's options, once JAX runs


@contextlib.contextmanager
def stationed(client: Client, order: Order) -> Iterator[str]:
    """The name under which `fly` finds `order` at every worker."""
    name = f"jaxguide-{uuid.uuid4().hex}"
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]
    station = Station(order, x64, flags.deciding())
    client.register_plugin(station, name=name)
    try:
        yield name
    finally:
        client.unregister_worker_plugin(name)


def fly(
    name: str, tiles: range, each: int, k: int, kept: tuple[str, ...]
) -> tuple[int, dict, dict]:
    """In a worker: number, rows (those that are `kept`) and sums of the chunk `k` of `tiles`, the
    histogram packed."""
    ready = get_worker().plugins[name].tiles  # pyright: ignore[reportAttributeAccessIssue]
    flown = over_cores(ready.fly, tiles, len(ready.devices))
    rows, sums = ready.chunk(list(flown), tiles.start, each)
    sums["histogram"] = packed(sums["histogram"])
    return k, {row: rows[row] for row in kept}, sums
