"""Chunks of a sweep over the workers of a Dask cluster. Host only."""

import itertools
from collections.abc import Iterator
from typing import Any

from jaxguide.sweeping.tally import unpacked
from jaxguide.sweeping.tiles import Order

_AHEAD = 3  # chunks submitted for each worker: one flown, two waiting, so that none idles
_RETRIES = 5  # of a chunk whose worker died: more means that the chunk itself kills workers
_TIMEOUT = 10.0  # s to wait for a scheduler's answer; a local network answers in well under one


def over_workers(
    order: Order,
    chunks: dict[int, range],
    each: int,
    kept: tuple[str, ...],
    quantities: int,
    scheduler: str,
) -> Iterator[tuple[int, dict, dict]]:
    """Flies `chunks` by the workers of a cluster; those of a worker that dies are flown again.

    **Arguments:** `chunks`: number -> tiles; `each`: tiles of a whole chunk; `kept`: the variables
    to return; `quantities`: how many have a histogram; `scheduler`: as for `jg.sweep`.

    **Returns:** number, rows and sums of each chunk, in the order in which they are done.

    **Raises:** `ValueError` for a scheduler that does not answer, `RuntimeError` without Dask.
    """
    try:
        from dask import distributed
    except ImportError as e:
        raise RuntimeError(
            "a sweep on a cluster needs Dask; install it with pip install 'jaxguide[sweep]'."
        ) from e
    from jaxguide.sweeping.station import fly_chunk, stationed

    with _client(distributed, scheduler) as client, stationed(client, order) as name:
        submit = lambda k: client.submit(
            fly_chunk, name, chunks[k], each, k, kept, retries=_RETRIES, pure=False
        )
        left = iter(chunks)
        room = _AHEAD * max(len(client.scheduler_info()["workers"]), 1)
        flying = {submit(k): k for k in itertools.islice(left, room)}
        coming = distributed.as_completed(list(flying))
        lost = 0
        for future in coming:
            k = flying.pop(future)
            following = itertools.islice(left, 1)
            try:
                k, rows, sums = future.result()
            # The scheduler computes the results of a dead worker again, except for those that it
            # has already released.
            except distributed.CancelledError:
                lost += 1
                if lost > _RETRIES * len(chunks):
                    raise
                following = [k]
            else:
                sums["histogram"] = unpacked(sums["histogram"], quantities)
                yield k, rows, sums
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
