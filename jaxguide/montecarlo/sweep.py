"""`jg.sweep`: many dispersed flights in fixed tiles, and their statistics. Host only."""

import functools
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Prepared, simulate
from jaxguide.montecarlo.covariance import linear_covariance
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.rollouts import apply, draw, shared
from jaxguide.montecarlo.statistics import summarise, wilson_bounds
from jaxguide.types import RESULTS

if TYPE_CHECKING:
    import xarray

# Lanes flown together: fixed, so that a case has the same bits in any sweep; its working set stays
# in a core's cache (chosen by experiment).
TILE = 4096


def sweep(
    mission: Mission,
    dispersions: dict[str, Distribution],
    cases: int,
    seed: int,
    *,
    store: Any = None,
    scheduler: Any = None,
    dtype: str | None = None,
    tile: int = TILE,
    progress: Any = None,
) -> "xarray.Dataset":
    """Flies `cases` dispersed missions and returns them as an xarray Dataset.

    Case k depends on (seed, k) alone. Cases are flown in fixed tiles of `tile` lanes, each in its
    own place of its tile, so that the same case gives the same bits whatever `cases` is. A failed
    case is a row with its reason, never an exception.

    **Arguments:** `dispersions`: path -> distribution; `dtype`: "float64" or "float32" (default
    the mission's own); `progress`: an object with init, step, close; `store`, `scheduler`: not
    yet; must be None.

    **Returns:** variables `initial_state`, `final_state` (case, state), `result` (case,), and
    `draw:path` for every dispersed leaf, `final_time` where the law decides it; attributes
    `rollouts_per_s` (warm), `compile_s`, `percentiles` (with confidence bounds), `success_rate`
    with Wilson bounds, `failures`, and the linear covariance beside the sampled one.

    **Raises:** `ValueError` for bad arguments.
    """
    import xarray as xr

    for name, value in (("store", store), ("scheduler", scheduler)):
        if value is not None:
            raise ValueError(f"sweep: {name} is {value!r}, but sweeps run in memory; leave it out.")
    if cases < 1:
        raise ValueError(f"sweep: cases is {cases}; give at least 1.")
    if tile < 1:
        raise ValueError(f"sweep: tile is {tile}; give at least 1.")
    if dtype is not None:
        mission = cast(mission, dtype)
    check = lambda: draw(mission, dispersions, jax.random.key(0))
    jax.eval_shape(check)  # refuses bad paths and shapes at once

    tiles = -(-cases // tile)
    key = jax.random.key(seed)
    began = time.perf_counter()
    prepared = _prepare(mission, dispersions)
    # What is not an array (a disturbance given as a function, say) is part of the program.
    given, rest = eqx.partition((mission, dispersions, prepared), eqx.is_array)
    rest = jax.tree_util.tree_flatten(rest)
    fly = _program(jax.default_backend())
    one = lambda i: jax.device_get(fly(given, key, jnp.asarray(i), tuple(rest[0]), rest[1], tile))
    one(0)
    compile_s = time.perf_counter() - began  # the first tile's flight included

    began = time.perf_counter()
    parts = over_cores(one, tiles, progress)
    elapsed = time.perf_counter() - began
    joined = jax.tree_util.tree_map(lambda *leaves: np.concatenate(leaves)[:cases], *parts)

    good = joined["code"] == _code(RESULTS.successful)
    states = mission.plant.state_names
    reasons, counts = np.unique(joined["code"][~good], return_counts=True)
    failures = {_message(int(code)): int(k) for code, k in zip(reasons, counts, strict=True)}
    centre, covariance = linear_covariance(mission, dispersions, prepared)
    finals = joined["final_state"][good]
    attrs = {
        "cases": cases,
        "seed": seed,
        "tile": tile,
        "dtype": str(joined["final_state"].dtype),
        "rollouts_per_s": tiles * tile / elapsed,
        "compile_s": compile_s,
        "failures": failures,
        "success_rate": float(good.mean()),
        "success_rate_bounds": wilson_bounds(int(good.sum()), cases),
        "percentiles": summarise(finals, states),
        "nominal_final_state": np.asarray(centre).tolist(),
        "linear_covariance": np.asarray(covariance).tolist(),
        "sample_covariance": (np.cov(finals.T) if len(finals) > 1 else np.zeros(covariance.shape))
        .reshape(covariance.shape)
        .tolist(),
    }
    variables = {
        "initial_state": (("case", "state"), joined["initial_state"]),
        "final_state": (("case", "state"), joined["final_state"]),
        "saturated": (("case",), joined["saturated"]),
        "result": (("case",), joined["code"]),
    }
    if "final_time" in joined:
        variables["final_time"] = (("case",), joined["final_time"])
        times = summarise(joined["final_time"][good][:, None], ("final_time",))
        attrs["percentiles"] = attrs["percentiles"] | times
    for path, values in joined["draws"].items():
        dims = ("case",) + tuple(f"{path}:{j}" for j in range(values.ndim - 1))
        variables[f"draw:{path}"] = (dims, values)
    return xr.Dataset(
        variables, coords={"case": np.arange(cases), "state": list(states)}, attrs=attrs
    )


def case_key(seed: Any, case: Any) -> Array:
    """The PRNG key of case `case`: (seed, case) and nothing else."""
    key = seed if isinstance(seed, jax.Array) else jax.random.key(seed)
    return jax.random.fold_in(key, case)


def over_cores(
    work: Callable[[int], Any], count: int, progress: Any = None, workers: int | None = None
) -> list[Any]:
    """`[work(0), ..., work(count - 1)]`, one thread a core: XLA flies each tile on one core and
    lets go of the interpreter lock meanwhile."""
    state = None if progress is None else progress.init()
    results = []
    try:
        with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
            for i, result in enumerate(pool.map(work, range(count))):
                results.append(result)
                if progress is not None:
                    state = progress.step(state, (i + 1) / count)
    finally:
        if progress is not None:
            progress.close(state)
    return results


def compiler_options() -> dict[str, Any]:
    """What XLA should do for flights: on CPU, use the full width of the vector units."""
    return {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}


_prepare = eqx.filter_jit(shared)


@functools.cache
def _program(backend: str) -> Any:
    """The compiled flight of one tile; one function, so that a second sweep compiles nothing."""
    del backend  # in the key of the cache, since it decides the options

    def tile_of(
        given: Any, key: Array, index: Array, leaves: tuple, treedef: Any, tile: int
    ) -> dict[str, Any]:
        rest = jax.tree_util.tree_unflatten(treedef, leaves)
        mission, dispersions, prepared = eqx.combine(given, rest)
        return _fly_tile(mission, dispersions, prepared, key, index, tile)

    return jax.jit(tile_of, static_argnums=(3, 4, 5), compiler_options=compiler_options())


def _fly_tile(
    mission: Mission,
    dispersions: dict[str, Distribution],
    prepared: Prepared | None,
    key: Array,
    index: Array,
    tile: int,
) -> dict[str, Any]:
    def fly(case: Array) -> dict[str, Any]:
        k_draw, k_noise = jax.random.split(case_key(key, case))
        draws = draw(mission, dispersions, k_draw)
        flown = apply(mission, draws)
        flight = simulate(flown, k_noise, "ends", prepared)
        # The time of the end says something only where the law decides it.
        ends = {"final_time": flight.final_time} if mission.law.decides_end else {}
        return {
            "initial_state": flown.initial_state,
            "final_state": flight.final_state,
            "saturated": flight.saturated,
            "code": flight.result._value,
            "draws": draws,
            **ends,
        }

    return jax.vmap(fly)(index * tile + jnp.arange(tile))


def cast(mission: Mission, dtype: str) -> Mission:
    """`mission` with every floating leaf in `dtype`: flights and sweeps also run in float32."""
    if dtype not in ("float32", "float64"):
        raise ValueError(f"dtype is {dtype!r}; choose 'float64' or 'float32'.")
    if dtype == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore
        raise ValueError("dtype 'float64' needs jax_enable_x64; enable it, or choose 'float32'.")
    floating = lambda a: eqx.is_array(a) and jnp.issubdtype(a.dtype, jnp.floating)
    change = lambda a: a.astype(dtype) if floating(a) else a
    return jax.tree_util.tree_map(change, mission)


def _code(item: RESULTS) -> int:
    return int(item._value)  # pyright: ignore


def _message(code: int) -> str:
    for name in RESULTS._name_to_item:  # pyright: ignore
        if _code(getattr(RESULTS, name)) == code:
            return name
    return f"code {code}"
