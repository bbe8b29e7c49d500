"""`jg.sweep`: many dispersed flights and their statistics, in memory or into a store. Host only."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.flight.mission import Mission
from jaxguide.montecarlo.cluster import over_workers
from jaxguide.montecarlo.cores import over_cores
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.identity import manifest
from jaxguide.montecarlo.rollouts import draw
from jaxguide.montecarlo.statistics import wilson_bounds
from jaxguide.montecarlo.store import Memory, Store
from jaxguide.montecarlo.tally import Tally
from jaxguide.montecarlo.tiles import TILE, Order, Tiles, code, message
from jaxguide.progress import NoProgress
from jaxguide.types import RESULTS

if TYPE_CHECKING:
    import xarray

CHUNK = 65_536  # cases written at once
_KEEP = ("all", "summary")
_MOST = 1e9  # bytes of results that a sweep keeps in memory


def sweep(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    cases: int,
    seed: int,
    *,
    store: Any = None,
    resume: bool = False,
    scheduler: str | None = None,
    dtype: str | None = None,
    keep: str = "all",
    chunk: int = CHUNK,
    tile: int = TILE,
    devices: Any = None,
    label: str | None = None,
    progress: Any = None,
) -> "xarray.Dataset":
    """Flies `cases` dispersed missions and returns them as an xarray Dataset.

    Case k depends on (seed, k) alone. Cases are flown in fixed tiles of `tile` lanes, each in its
    own place of its tile, so that a case has the same bits whatever `cases`, `chunk`, `devices`
    and `scheduler` are; sums are taken tile by tile, in order, so that statistics have too. A
    failed case is a row with its reason, never an exception.

    **Arguments:**

    - `dispersions`: path (or paths, as a tuple) -> distribution.
    - `store`: a directory for a Zarr store (needs `jaxguide[sweep]`); the Dataset is then read
      from it when asked. Written chunk by chunk: killed at any instant, the same sweep with
      `resume` ends with the same bits.
    - `scheduler`: address of a Dask scheduler, "tcp://host:port", or "local" for a cluster of
      processes here; chunks go to its workers, and again if one dies.
    - `dtype`: "float64" or "float32" (default the mission's own).
    - `keep`: "all", or "summary": statistics and each case's result alone.
    - `chunk`: cases written at once, rounded up to whole tiles. `devices`: JAX devices to fly on
      (default all local ones). `progress`: an object with init, step, close.
    - `label`: a name that the store keeps.

    **Returns:** variables `initial_state`, `final_state` (case, state), `saturated`, `result`
    (case,), `draw:path` for every dispersed leaf, `final_time` where the law decides it; attributes
    `rollouts_per_s` (warm), `compile_s`, `percentiles` (with confidence bounds), `success_rate`
    with Wilson bounds, `failures`, and the linear covariance beside the sampled one.

    **Error:** percentiles to 2^-12 of their distance from the undispersed flight.

    **Raises:** `ValueError` for bad arguments, a store of another sweep or a scheduler that does
    not answer; `OSError` where the store cannot be written: what was is kept.
    """
    _check(cases, tile, chunk, keep, resume, store)
    if dtype is not None:
        mission = cast(mission, dtype)
    check = lambda: draw(mission, dispersions, jax.random.key(0))
    jax.eval_shape(check)  # refuses bad paths and shapes at once

    order = Order(mission, dispersions, seed, cases, tile)
    tiles = Tiles(order, devices)
    variables = {k: v for k, v in tiles.rows().items() if keep == "all" or k == "result"}
    each = -(-chunk // tile)
    coordinates = {"state": np.array(mission.plant.state_names)}
    if store is None:
        need = cases * sum(
            np.prod(shape) * dtype.itemsize for _, shape, dtype in variables.values()
        )
        if need > _MOST:
            raise ValueError(
                f"sweep: {cases} cases would leave {need / 1e9:.1f} GB in memory; give a store to "
                'write them to, or keep="summary".'
            )
        book: Any = Memory(variables, coordinates, cases, each * tile)
    else:
        described = manifest(order) | {"keep": keep, "label": label}
        book = Store(Path(store), described, variables, coordinates, each * tile, resume)
    todo = [k for k in range(-(-tiles.count // each)) if not book.has(k)]

    began = time.perf_counter()
    if todo and scheduler is None:
        tiles.fly(todo[0] * each)
    compile_s = time.perf_counter() - began  # a tile's flight included
    began, flown = time.perf_counter(), 0
    meter = NoProgress() if progress is None else progress
    state = meter.init()
    try:
        for k, rows, sums in _flown(tiles, todo, each, scheduler):
            book.write(k, {name: rows[name] for name in variables}, sums)
            flown += len(rows["result"])
            state = meter.step(state, flown / max(min(cases, len(todo) * each * tile), 1))
    finally:
        meter.close(state)
    elapsed = time.perf_counter() - began
    attrs = {
        "cases": cases,
        "seed": seed,
        "tile": tile,
        "dtype": str(mission.initial_state.dtype),
        "rollouts_per_s": flown / elapsed,
        "compile_s": compile_s,
        **_statistics(tiles, book, cases),
    }
    return book.dataset(attrs)


def _check(cases: int, tile: int, chunk: int, keep: str, resume: bool, store: Any) -> None:
    for name, value in (("cases", cases), ("tile", tile), ("chunk", chunk)):
        if value < 1:
            raise ValueError(f"sweep: {name} is {value}; give at least 1.")
    if keep not in _KEEP:
        raise ValueError(f"sweep: keep is {keep!r}; choose one of {', '.join(_KEEP)}.")
    if resume and store is None:
        raise ValueError("sweep: resume needs the store to go on with.")


def _flown(
    tiles: Tiles, todo: list[int], each: int, scheduler: str | None
) -> Iterator[tuple[int, dict, dict]]:
    """Number, rows and sums of each chunk of `todo`."""
    of_chunk = lambda k: range(k * each, min((k + 1) * each, tiles.count))
    if scheduler is not None:
        yield from over_workers(tiles.order, {k: of_chunk(k) for k in todo}, each, scheduler)
        return
    flown = over_cores(tiles.fly, (i for k in todo for i in of_chunk(k)))
    for k in todo:
        rows, sums = tiles.chunk([next(flown) for _ in of_chunk(k)], each)
        yield k, rows, sums


def _statistics(tiles: Tiles, book: Any, cases: int) -> dict[str, Any]:
    totals = book.totals()
    tally = Tally(*tiles.reference, totals["moments"], totals["histogram"])
    codes = totals["codes"]
    good = int(codes[code(RESULTS.successful)])
    n = len(tiles.order.mission.plant.state_names)
    return {
        "failures": {
            message(i): int(count)
            for i, count in enumerate(codes)
            if count and i != code(RESULTS.successful)
        },
        "success_rate": good / cases,
        "success_rate_bounds": wilson_bounds(good, cases),
        "percentiles": tally.summary(tiles.names),
        "nominal_final_state": tiles.centre.tolist(),
        "linear_covariance": tiles.covariance.tolist(),
        "sample_covariance": tally.covariance[:n, :n].tolist(),
    }


def cast(mission: Mission, dtype: str) -> Mission:
    """`mission` with every floating leaf in `dtype`: flights and sweeps also run in float32."""
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype is {dtype!r}; choose 'float64' or 'float32'.")
    if dtype == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore
        raise ValueError("dtype 'float64' needs jax_enable_x64; enable it, or choose 'float32'.")
    floating = lambda a: eqx.is_array(a) and jnp.issubdtype(a.dtype, jnp.floating)
    change = lambda a: a.astype(dtype) if floating(a) else a
    return jax.tree_util.tree_map(change, mission)
