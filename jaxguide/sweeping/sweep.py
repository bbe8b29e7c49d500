"""`jg.sweep`: many dispersed flights and their statistics, in memory or into a store. Host only."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.flight.mission import Mission
from jaxguide.host.memory import trim
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.rollouts import dimensions, draw
from jaxguide.montecarlo.sampling import SAMPLINGS
from jaxguide.montecarlo.statistics import wilson_bounds
from jaxguide.sweeping import importance, ranking
from jaxguide.sweeping.chunks import Flights, SweepPlan, fly_chunks, tally_of
from jaxguide.sweeping.histories import cases_in_full, in_full, program_in_full
from jaxguide.sweeping.identity import about, manifest
from jaxguide.sweeping.keeping import AbstractStore, Memory, import_beside
from jaxguide.sweeping.stopping import Stop, fitting
from jaxguide.sweeping.store import EARLIER, Store, differences, made_earlier
from jaxguide.sweeping.tiles import TILE, Order, Tiles
from jaxguide.sweeping.written import dispersions_from
from jaxguide.types import RESULTS, code, message

if TYPE_CHECKING:
    import xarray

CHUNK = 65_536  # cases written at once: files of about a megabyte a variable
_KEEP = ("all", "summary")
_MANY = 1_000_000  # cases from which giving memory back is worth the few milliseconds that it takes
_SOFTWARE = ("jax", "xla", "programs", "sums")  # entries of a manifest
_MOST = 1e9  # bytes of results that a sweep may keep in memory


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

    Case k depends on (seed, k) alone. Cases are flown in fixed tiles of `tile` cases, each in its
    own lane of its tile, so that a case has the same bits whatever `cases`, `chunk`, `devices`
    and `scheduler` are; sums are taken tile by tile, in order, so that the same holds of
    statistics. A failed case is a row with its reason, never an exception.

    **Arguments:**

    - `dispersions`: path (or paths, as a tuple) -> distribution.
    - `store`: a directory for a Zarr store (needs `jaxguide[sweep]`); values of the Dataset are
      then read from it when used. It is written chunk by chunk: a sweep that was killed at any
      instant ends with the same bits if it is flown again with `resume`.
    - `resume`: whether the store may already hold a part of this sweep, or all of it. A store of
      another sweep is refused: one that differs in seed, sizes, mission, dispersions, in the
      programs that they are flown by, or in the versions and options of JAX.
    - `scheduler`: address of a Dask scheduler, "tcp://host:port", or "local" for a cluster of
      processes on this machine; its workers fly the chunks, those of a worker that dies again.
    - `dtype`: "float64" or "float32" (default the mission's own).
    - `sampling`: "random"; or, to spread the cases evenly over their distributions,
      "latin_hypercube" (which depends on `cases` too) or "sobol" (best with a power of two). Bounds
      of statistics are those of random cases, too wide for the others.
    - `keep`: "all", or "summary": only the statistics and the result of each case.
    - `histories`: how many cases, the first, are kept with their whole histories; `failures`: how
      many of those that failed, too. They are flown again when the others are done.
    - `stop`: a rule such as `jg.SuccessWithin(0.01)`, which may end the sweep before `cases`; it
      looks every 16 tiles, and `chunk` is rounded to divide that.
    - `chunk`: cases written at once, rounded up to whole tiles. `devices`: JAX devices to fly on
      (default all local ones). `progress`: an object with init, step, close.
    - `label`: a name that the store keeps.

    **Returns:** variables `initial_state`, `final_state` (case, state), `saturated`, `result`
    (case,), `miss` (by how much the endpoint constraints are missed, Euclidean norm, in units of
    `mission.miss` or their own), for every dispersed leaf `draw:path`, its deviation, and
    `applied:path`, its flown value, `final_time` where the law decides it; `history_case`,
    `history_t`, `history_x`, `history_u` of the full flights; attributes `flown`, `rollouts_per_s`
    (warm), `compile_s`, `percentiles` (with confidence bounds), `success_rate` with Wilson bounds,
    `failures`, the linear covariance beside the sampled one, `importance` of each dispersed number
    (first-order Sobol indices with the half width of their 95 % bounds, from the first 64 tiles)
    beside `linear_importance`, and the `worst` cases.

    **Error:** percentiles to 2^-12 of their distance from the undispersed flight.

    **Speed:** `jaxguide sweep` starts XLA with `jaxguide.host.flags.FLIGHTS`, which doubles
    the rate on a CPU; a program of one's own may call `flags.set_for_flights()` before it imports
    JAX.

    **Raises:** `ValueError` for bad arguments, a store of another sweep or a scheduler that does
    not answer; `OSError` if the store cannot be written: the chunks before are kept;
    `RuntimeError` if a case was not flown with the deviations drawn for it.
    """
    _check_arguments(cases, tile, chunk, keep, resume, store, sampling, stop, histories, failures)
    mission = mission if dtype is None else cast(mission, dtype)
    _check_dispersions(mission, dispersions, sampling)
    import_beside()
    if cases >= _MANY:
        trim()
    order = Order(mission, dispersions, seed, cases, tile, sampling)
    tiles = Tiles(order, devices)
    if stop is not None:
        stop.check(tiles.names)
    each = -(-chunk // tile)
    each = each if stop is None else fitting(each)
    variables = {k: v for k, v in tiles.rows().items() if keep == "all" or k == "result"}
    if store is None:
        kept_by = _memory(order, variables)
    else:
        asked = {"keep": keep, "label": label, "stop": repr(stop)}
        asked |= {"histories": histories, "failures": failures}
        kept_by = _opened(Path(store), tiles, asked, variables, each, resume)
    plan = SweepPlan(tiles, kept_by, each, tuple(variables), stop, scheduler)

    missing = [k for k in range(plan.count) if not kept_by.has(k)]
    compile_s = _compiled(tiles) if missing and scheduler is None else 0.0
    flights = fly_chunks(plan, missing, progress)
    kept_by.stop_at(flights.ended)
    statistics = _statistics(tiles, flights)
    full = cases_in_full(kept_by.results(), code(RESULTS.successful), histories, failures)
    if not kept_by.finished(full):
        kept_by.finish(statistics, in_full(order, full))
    attrs = {
        "cases": cases,
        "seed": seed,
        "tile": tile,
        "dtype": str(mission.initial_state.dtype),
        "about": about(order),
        "rollouts_per_s": flights.flown / flights.seconds,
        "compile_s": compile_s,
        **statistics,
    }
    return kept_by.dataset(attrs)


def _check_arguments(
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


def _check_dispersions(
    mission: Mission, dispersions: dict[Any, Distribution], sampling: str
) -> None:
    """Refuses bad paths and shapes before anything is compiled."""
    key = lambda: jax.random.key(0)
    jax.eval_shape(lambda: draw(mission, dispersions, key()))
    if sampling != "random":
        middle = jnp.full(dimensions(mission, dispersions), 0.5)
        jax.eval_shape(lambda: draw(mission, dispersions, key(), middle))


def _memory(order: Order, variables: dict[str, Any]) -> Memory:
    sizes = (np.prod(shape) * dtype.itemsize for _, shape, dtype in variables.values())
    need = order.cases * sum(sizes)
    if need > _MOST:
        raise ValueError(
            f"sweep: {order.cases} cases would leave {need / 1e9:.1f} GB in memory; give a store "
            'to write them to, or keep="summary".'
        )
    return Memory(variables, _coordinates(order), order.cases)


def _opened(
    path: Path,
    tiles: Tiles,
    asked: dict[str, Any],
    variables: dict[str, Any],
    each: int,
    resume: bool,
) -> AbstractStore:
    """The store at `path` for this sweep. `asked`: those arguments of `sweep` that decide what is
    stored, and not how it is flown."""
    order = tiles.order
    whole = manifest(order, _programs(tiles, asked)) | asked
    size = each * order.tile
    return Store(path, whole, variables, _coordinates(order), size, resume, about(order))


def _coordinates(order: Order) -> dict[str, np.ndarray]:
    return {"state": np.array(order.mission.plant.state_names)}


def _programs(tiles: Tiles, asked: dict[str, Any]) -> dict[str, str]:
    """Text of every program of a sweep, that of its full flights included if there are any."""
    programs = tiles.programs()
    if asked["histories"] or asked["failures"]:
        programs["histories"] = program_in_full(tiles.order)
    return programs


def _compiled(tiles: Tiles) -> float:
    """Compiles the program of a tile, and returns the seconds that it took."""
    began = time.perf_counter()
    _ = tiles.bins  # flies a tile
    if tiles.order.cases >= _MANY:
        trim()
    return time.perf_counter() - began


def _statistics(tiles: Tiles, flights: Flights) -> dict[str, Any]:
    totals, ended = flights.totals, flights.ended
    tally = tally_of(tiles, totals)
    codes = totals["codes"]
    good = int(codes[code(RESULTS.successful)])
    n = len(tiles.order.mission.plant.state_names)
    variance = np.diag(tally.covariance)
    shares = importance.first_order(totals["bins"], variance, totals["unit"])
    return {
        "flown": ended,
        "sampling": tiles.order.sampling,
        "failures": {
            message(i): int(count)
            for i, count in enumerate(codes)
            if count and i != code(RESULTS.successful)
        },
        "success_rate": good / ended,
        "success_rate_bounds": wilson_bounds(good, ended),
        "quantities": list(tiles.names),
        "reference": {"centre": tally.centre.tolist(), "scale": tally.scale.tolist()},
        "percentiles": tally.summary(tiles.names),
        "nominal_final_state": tiles.centre.tolist(),
        "linear_covariance": tiles.covariance.tolist(),
        "sample_covariance": tally.covariance[:n, :n].tolist(),
        "importance": importance.by_outcome(tiles.drawn_names, tiles.names, shares),
        "linear_importance": tiles.linear_shares,
        "worst": ranking.as_records(totals["worst"], message),
    }


def again(
    found: dict[str, Any], mission: Mission, dispersions: dict[Any, Distribution], store: Any
) -> tuple[dict[Any, Distribution], str]:
    """What is needed to fly a case of the stored sweep again.

    **Arguments:** `found`: the manifest of `store`, with its `about`; `mission`, `dispersions`: of
    the library, under the name that the sweep was flown by.

    **Returns:** the dispersions of the sweep, read from the store if it could write them, else
    `dispersions`; and a note that names the software that has changed since, "" if none has.

    **Raises:** `ValueError` naming what differs, if `mission` is not the one that was flown.
    """
    if made_earlier(found):
        raise ValueError(f"{store} cannot be compared with this mission. {EARLIER}")
    about = found.get("about", {})
    if about.get("written"):
        dispersions = dispersions_from(about["dispersions"])
    sizes = found["seed"], found["cases"], found["tile"], found["sampling"]
    order = Order(mission, dispersions, *sizes)
    now = manifest(order, _programs(Tiles(order), found))
    pick = lambda entries, names: {name: entries[name] for name in names}
    flown_by = ("mission", "dispersions", "dtype")
    changed = differences(pick(now, flown_by), pick(found, flown_by))
    if changed:
        raise ValueError(
            f"{store} was flown by another mission: {changed}. Check out the version that made it, "
            "or sweep again into another directory."
        )
    software = differences(pick(now, _SOFTWARE), pick(found, _SOFTWARE))
    return dispersions, f"made by other software: {software}" if software else ""


def cast(mission: Mission, dtype: str) -> Mission:
    """`mission` with every floating leaf in `dtype`: flights and sweeps also run in float32.

    A leaf that has this type is left as it is, weakly typed or not, so that its programs are too.

    **Raises:** `ValueError` for another type, or "float64" without 64 bits enabled.
    """
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype is {dtype!r}; choose 'float64' or 'float32'.")
    if dtype == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore
        raise ValueError("dtype 'float64' needs jax_enable_x64; enable it, or choose 'float32'.")
    floating = lambda a: eqx.is_array(a) and jnp.issubdtype(a.dtype, jnp.floating)
    change = lambda a: a.astype(dtype) if floating(a) and a.dtype != dtype else a
    return jax.tree_util.tree_map(change, mission)
