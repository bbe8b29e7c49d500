"""Work spread over host threads: XLA runs each program on one core, and releases the interpreter's
lock meanwhile. Host only."""

import collections
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def over_cores(
    work: Callable[[Any], Any], items: Iterable[Any], workers: int | None = None
) -> Iterator[Any]:
    """`work(item)` for each item, in order, by `workers` threads (default: one for each core).

    They work ahead of the consumer by at most three items each.
    """
    workers = workers or os.cpu_count() or 1
    pool = ThreadPoolExecutor(workers)
    try:
        left = iter(items)
        ahead = collections.deque(pool.submit(work, i) for i in itertools.islice(left, 3 * workers))
        while ahead:
            yield ahead.popleft().result()
            ahead.extend(pool.submit(work, i) for i in itertools.islice(left, 1))
    finally:
        pool.shutdown(cancel_futures=True)
