"""A sweep's order made ready at every worker of a Dask cluster. Host only; imports Dask."""

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
    """Holds `order`, and its tiles, in a worker process.

    It is a plugin because the scheduler gives plugins also to workers that join or restart later;
    scattered data would be lost with the workers that hold it.

    **Arguments:** `x64`: whether the client has JAX in 64 bits; `options`: XLA's options of the
    client that may change a rounding.
    """

    def __init__(self, order: Order, x64: bool, options: str):
        self.order, self.x64, self.options = order, x64, options

    @functools.cached_property
    def tiles(self) -> Tiles:
        """The tiles of `order`, made ready when first used.

        **Raises:** `RuntimeError` if this worker runs XLA with other options.
        """
        # With other options than the client's, the bits would be others. A worker starts JAX, and
        # reads the options, with its first order.
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
    """Puts `order` into every worker of `client`; gives the name by which `fly_chunk` finds it."""
    name = f"jaxguide-{uuid.uuid4().hex}"
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]
    station = Station(order, x64, flags.deciding())
    client.register_plugin(station, name=name)
    try:
        yield name
    finally:
        client.unregister_worker_plugin(name)


def fly_chunk(
    name: str, tiles: range, each: int, k: int, kept: tuple[str, ...]
) -> tuple[int, dict, dict]:
    """In a worker: flies chunk `k`, which holds `tiles`, at most `each` of them.

    **Returns:** `k`, the rows `kept` and the sums, the histogram `packed`.
    """
    ready = get_worker().plugins[name].tiles  # pyright: ignore[reportAttributeAccessIssue]
    parts = over_cores(ready.fly, tiles, len(ready.devices))
    rows, sums = ready.chunk(list(parts), tiles.start, each)
    sums["histogram"] = packed(sums["histogram"])
    return k, {row: rows[row] for row in kept}, sums
