"""`jg.sweep`: many dispersed flights and their statistics, in memory or into a store. Host only."""

import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.flight.mission import Mission
from jaxguide.host.cores import over_cores
from jaxguide.host.memory import trim
from jaxguide.host.progress import NoProgress
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.rollouts import dimensions, draw
from jaxguide.montecarlo.sampling import SAMPLINGS
from jaxguide.montecarlo.statistics import wilson_bounds
from jaxguide.sweeping import importance, ranking
from jaxguide.sweeping.cluster import over_workers
from jaxguide.sweeping.histories import chosen, in_full
from jaxguide.sweeping.identity import about, manifest
from jaxguide.sweeping.stopping import LOOK, Stop, fitting
from jaxguide.sweeping.store import Memory, Store, Totals, differences
from jaxguide.sweeping.tally import Tally
from jaxguide.sweeping.tiles import TILE, Order, Tiles
from jaxguide.sweeping.written import dispersions_from
from jaxguide.types import RESULTS, code, message

if TYPE_CHECKING:
    import xarray

CHUNK = 65_536  # cases written at once
_KEEP = ("all", "summary")
_MANY = 1_000_000  # cases from which memory is worth the few milliseconds of giving it back
_SOFTWARE = ("jax", "jaxguide", "xla")
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
    sampling: str = "random",
    keep: str = "all",
    histories: int = 0,
    failures: int = 0,
    stop: Stop | None = None,
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
    - `sampling`: "random"; or, to spread the cases evenly over their distributions,
      "latin_hypercube" (which depends on `cases` too) or "sobol" (best with a power of two). Bounds
      of statistics are those of random cases, too wide for the others.
    - `keep`: "all", or "summary": statistics and each case's result alone.
    - `histories`: so many cases, the first, are kept in full; `failures`: so many of those that
      failed, too. They are flown again when the others are done.
    - `stop`: a rule such as `jg.SuccessWithin(0.01)`, which may end the sweep before `cases`; it
      looks every 16 tiles, and `chunk` is rounded to divide that.
    - `chunk`: cases written at once, rounded up to whole tiles. `devices`: JAX devices to fly on
      (default all local ones). `progress`: an object with init, step, close.
    - `label`: a name that the store keeps.

    **Returns:** variables `initial_state`, `final_state` (case, state), `saturated`, `result`
    (case,), `miss` (the length of what the endpoint constraints are off, in units of `mission.miss`
    or their own), `draw:path` for every dispersed leaf and `applied:path`, what the leaf became,
    `final_time` where the law decides it; `history_case`, `history_t`, `history_x`, `history_u` of
    the flights in full; attributes `flown`, `rollouts_per_s` (warm), `compile_s`, `percentiles`
    (with confidence bounds), `success_rate` with Wilson bounds, `failures`, the linear covariance
    beside the sampled one, `importance` of each dispersed number (first-order Sobol indices with
    the half width of their 95 % bounds, from the first 64 tiles) beside `linear_importance`, and
    the `worst` cases.

    **Error:** percentiles to 2^-12 of their distance from the undispersed flight.

    **Speed:** `jaxguide sweep` starts XLA with `jaxguide.host.flags.FLIGHTS`, which doubles
    the rate on a CPU; a program of one's own may call `flags.set_for_flights()` before it imports
    JAX.

    **Raises:** `ValueError` for bad arguments, a store of another sweep or a scheduler that does
    not answer; `OSError` where the store cannot be written: what was is kept; `RuntimeError` where
    a case was not flown with what was drawn for it.
    """
    _check(cases, tile, chunk, keep, resume, store, sampling, stop, histories, failures)
    if dtype is not None:
        mission = cast(mission, dtype)
    check = lambda: draw(mission, dispersions, jax.random.key(0))
    jax.eval_shape(check)  # refuses bad paths and shapes at once
    if sampling != "random":
        half = jnp.full(dimensions(mission, dispersions), 0.5)
        jax.eval_shape(lambda: draw(mission, dispersions, jax.random.key(0), half))

    if cases >= _MANY:
        trim()
    order = Order(mission, dispersions, seed, cases, tile, sampling)
    tiles = Tiles(order, devices)
    if stop is not None:
        stop.check(tiles.names)
    variables = {k: v for k, v in tiles.rows().items() if keep == "all" or k == "result"}
    each = -(-chunk // tile)
    each = each if stop is None else fitting(each)
    coordinates = {"state": np.array(mission.plant.state_names)}
    if store is None:
        _check_memory(cases, variables)
        book: Any = Memory(variables, coordinates, cases, each * tile)
    else:
        told = manifest(order) | {"keep": keep, "label": label, "stop": repr(stop)}
        told |= {"histories": histories, "failures": failures}
        book = Store(Path(store), told, variables, coordinates, each * tile, resume, about(order))
    count = -(-tiles.count // each)
    todo = [k for k in range(count) if not book.has(k)]

    began = time.perf_counter()
    if todo and scheduler is None:
        _ = tiles.bins  # compiles, by flying a tile
        if cases >= _MANY:
            trim()
    compile_s = time.perf_counter() - began
    began, flown = time.perf_counter(), 0
    meter = NoProgress() if progress is None else progress
    state = meter.init()
    totals = Totals()
    coming = _flown(tiles, todo, each, tuple(variables), scheduler)
    coming = coming if stop is None else _in_order(coming, todo)
    waiting, ended = set(todo), cases
    try:
        for k in range(count):
            # Without a rule, what comes first is taken first.
            k, rows, sums = next(coming) if k in waiting else (k, None, book.sums(k))
            totals.add(k, sums)
            if rows is not None:
                book.write(k, {name: rows[name] for name in variables}, sums)
                flown += len(rows["result"])
                done = flown / max(min(cases, len(todo) * each * tile), 1)
                state = meter.step(state, done)
            if stop is not None and (k + 1) * each % LOOK == 0:
                so_far = totals.all()
                if stop.enough(_tally(tiles, so_far), tiles.names, so_far["codes"]):
                    ended = min((k + 1) * each * tile, cases)
                    break
    finally:
        coming.close()
        meter.close(state)
    elapsed = time.perf_counter() - began
    book.stop_at(ended)
    found = _statistics(tiles, totals.all(), ended)
    full = chosen(book.results(), code(RESULTS.successful), histories, failures)
    if not book.finished(full):
        book.finish(found, in_full(order, full))
    attrs = {
        "cases": cases,
        "seed": seed,
        "tile": tile,
        "dtype": str(mission.initial_state.dtype),
        "about": about(order),
        "rollouts_per_s": flown / elapsed,
        "compile_s": compile_s,
        **found,
    }
    return book.dataset(attrs)


def _check(
    cases: int,
    tile: int,
    chunk: int,
    keep: str,
    resume: bool,
    store: Any,
    sampling: str,
    stop: Stop | None,
    histories: int,
    failures: int,
) -> None:
    for name, value in (("cases", cases), ("tile", tile), ("chunk", chunk)):
        if value < 1:
            raise ValueError(f"sweep: {name} is {value}; give at least 1.")
    for name, value in (("histories", histories), ("failures", failures)):
        if value < 0:
            raise ValueError(f"sweep: {name} is {value}; give 0 or more.")
    for name, value, known in (("keep", keep, _KEEP), ("sampling", sampling, SAMPLINGS)):
        if value not in known:
            raise ValueError(f"sweep: {name} is {value!r}; choose one of {', '.join(known)}.")
    if resume and store is None:
        raise ValueError("sweep: resume needs the store to go on with.")
    if stop is not None and sampling == "latin_hypercube":
        raise ValueError(
            "sweep: a Latin hypercube is even only when all its cases are flown, so it takes no "
            'stop; choose sampling="sobol" or "random".'
        )


def _check_memory(cases: int, variables: dict[str, Any]) -> None:
    need = cases * sum(np.prod(shape) * dtype.itemsize for _, shape, dtype in variables.values())
    if need > _MOST:
        raise ValueError(
            f"sweep: {cases} cases would leave {need / 1e9:.1f} GB in memory; give a store to "
            'write them to, or keep="summary".'
        )


def _flown(
    tiles: Tiles, todo: list[int], each: int, kept: tuple[str, ...], scheduler: str | None
) -> Generator[tuple[int, dict, dict]]:
    """Number, rows and sums of each chunk of `todo`."""
    of_chunk = lambda k: range(k * each, min((k + 1) * each, tiles.count))
    if scheduler is not None:
        chunks = {k: of_chunk(k) for k in todo}
        yield from over_workers(tiles.order, chunks, each, kept, len(tiles.names), scheduler)
        return
    flown = over_cores(tiles.fly, (i for k in todo for i in of_chunk(k)))
    for k in todo:
        rows, sums = tiles.chunk([next(flown) for _ in of_chunk(k)], k * each, each)
        yield k, rows, sums


def _in_order(
    coming: Iterator[tuple[int, dict, dict]], todo: list[int]
) -> Generator[tuple[int, dict, dict]]:
    """The same in the order of `todo`, as a rule that stops the sweep needs them; a few wait for
    the slowest worker."""
    early: dict[int, tuple[int, dict, dict]] = {}
    for k in todo:
        while k not in early:
            one = next(coming)
            early[one[0]] = one
        yield early.pop(k)


def _tally(tiles: Tiles, totals: dict[str, np.ndarray]) -> Tally:
    return Tally(*tiles.reference, totals["moments"], totals["histogram"])


def _statistics(tiles: Tiles, totals: dict[str, np.ndarray], flown: int) -> dict[str, Any]:
    tally = _tally(tiles, totals)
    codes = totals["codes"]
    good = int(codes[code(RESULTS.successful)])
    n = len(tiles.order.mission.plant.state_names)
    variance = np.diag(tally.covariance)
    shares = importance.first_order(totals["bins"], variance, totals["unit"])
    return {
        "flown": flown,
        "sampling": tiles.order.sampling,
        "failures": {
            message(i): int(count)
            for i, count in enumerate(codes)
            if count and i != code(RESULTS.successful)
        },
        "success_rate": good / flown,
        "success_rate_bounds": wilson_bounds(good, flown),
        "quantities": list(tiles.names),
        "reference": {"centre": tally.centre.tolist(), "scale": tally.scale.tolist()},
        "percentiles": tally.summary(tiles.names),
        "nominal_final_state": tiles.centre.tolist(),
        "linear_covariance": tiles.covariance.tolist(),
        "sample_covariance": tally.covariance[:n, :n].tolist(),
        "importance": importance.told(tiles.drawn_names, tiles.names, shares),
        "linear_importance": tiles.linear_shares,
        "worst": ranking.told(totals["worst"], message),
    }


def again(
    told: dict[str, Any], mission: Mission, dispersions: dict[Any, Distribution], store: Any
) -> tuple[dict[Any, Distribution], str]:
    """The dispersions of the stored sweep that `told` describes, and what of the software has
    changed since ("" if nothing): its own where it could write them, else `dispersions`.

    **Raises:** `ValueError` naming what differs, where `mission` is not what was flown.
    """
    about = told.get("about", {})
    if about.get("written"):
        dispersions = dispersions_from(about["dispersions"])
    order = Order(mission, dispersions, told["seed"], told["cases"], told["tile"], told["sampling"])
    now = manifest(order)
    pick = lambda of, names: {name: of[name] for name in names}
    flown = ("mission", "dispersions", "dtype")
    changed = differences(pick(now, flown), pick(told, flown))
    if changed:
        raise ValueError(
            f"{store} was flown by another mission: {changed}. Check out what made it, or sweep "
            "again into another directory."
        )
    software = differences(pick(now, _SOFTWARE), pick(told, _SOFTWARE))
    return dispersions, f"made by other software: {software}" if software else ""


def cast(mission: Mission, dtype: str) -> Mission:
    """`mission` with every floating leaf in `dtype`: flights and sweeps also run in float32."""
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype is {dtype!r}; choose 'float64' or 'float32'.")
    if dtype == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore
        raise ValueError("dtype 'float64' needs jax_enable_x64; enable it, or choose 'float32'.")
    floating = lambda a: eqx.is_array(a) and jnp.issubdtype(a.dtype, jnp.floating)
    change = lambda a: a.astype(dtype) if floating(a) else a
    return jax.tree_util.tree_map(change, mission)
