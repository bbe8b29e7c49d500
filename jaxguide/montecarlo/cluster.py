"""Chunks of a sweep over the workers of a Dask cluster. Host only."""

import functools
import itertools
from collections.abc import Iterator
from typing import Any

import jax

from jaxguide.montecarlo.cores import over_cores
from jaxguide.montecarlo.tiles import Order, Tiles

_AHEAD = 3  # chunks under way, a worker
_RETRIES = 5  # of a chunk whose worker died
_TIMEOUT = 10.0  # seconds until a scheduler that does not answer is given up


def over_workers(
    order: Order, chunks: dict[int, range], each: int, scheduler: str
) -> Iterator[tuple[int, dict, dict]]:
    """Number, rows and sums of each chunk, as they come; those of a worker that dies are flown
    again by another.

    **Raises:** `ValueError` for a scheduler that does not answer, `RuntimeError` without Dask.
    """
    try:
        from dask import distributed
    except ImportError as e:
        raise RuntimeError(
            "a sweep on a cluster needs Dask; install it with pip install 'jaxguide[sweep]'."
        ) from e
    x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore
    with _client(distributed, scheduler) as client:
        # Scattered, so that a worker makes it ready once; anew where all copies were lost.
        send = lambda: client.scatter(order, broadcast=True, hash=False)
        sent = send()
        submit = lambda k: client.submit(
            _chunk, sent, chunks[k], each, k, x64, retries=_RETRIES, pure=False
        )
        left = iter(chunks)
        room = _AHEAD * max(len(client.scheduler_info()["workers"]), 1)
        flying = {submit(k): k for k in itertools.islice(left, room)}
        coming = distributed.as_completed(list(flying))
        lost = 0
        for future in coming:
            k = flying.pop(future)
            if future.status in ("cancelled", "lost") and lost < _RETRIES * len(chunks):
                lost += 1
                sent = send() if sent.status != "finished" else sent
                following = [k]
            else:
                yield future.result()
                following = list(itertools.islice(left, 1))
            for k in following:
                flying[again := submit(k)] = k
                coming.add(again)


def _client(distributed: Any, scheduler: str) -> Any:
    if scheduler == "local":
        return distributed.Client(processes=True, threads_per_worker=1, dashboard_address=None)
    try:
        return distributed.Client(scheduler, timeout=_TIMEOUT)
    except (OSError, ValueError) as e:
        raise ValueError(
            f"sweep: no Dask scheduler answers at {scheduler!r} ({e}); start one with `dask "
            'scheduler`, or pass scheduler="local".'
        ) from e


def _chunk(order: Order, tiles: range, each: int, k: int, x64: bool) -> tuple[int, dict, dict]:
    """In a worker: flies `tiles`."""
    jax.config.update("jax_enable_x64", x64)
    ready = _ready(_Same(order))
    flown = over_cores(ready.fly, tiles, len(ready.devices))
    rows, sums = ready.chunk(list(flown), each)
    return k, rows, sums


class _Same:
    """Equal if the same object: a worker keeps one copy of what was scattered."""

    def __init__(self, order: Order):
        self.order = order

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _Same) and self.order is other.order

    def __hash__(self) -> int:
        return id(self.order)


@functools.lru_cache(maxsize=2)
def _ready(same: _Same) -> Tiles:
    return Tiles(same.order)
