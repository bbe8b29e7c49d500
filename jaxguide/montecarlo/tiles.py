"""Flights in tiles: as many lanes as one program flies together, each in a place that its number
fixes, so that a case has the same bits in any sweep, chunk, device and process. Host only."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Prepared, simulate
from jaxguide.montecarlo.covariance import linear_covariance
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.rollouts import apply, case_key, draw, shared
from jaxguide.montecarlo.tally import BINS, count_in, tile_moments
from jaxguide.types import RESULTS

# Lanes flown together: their working set stays in a core's cache (chosen by experiment).
TILE = 4096


class Order(NamedTuple):
    """What is to be flown: all that a case's bits depend on, and how many cases there are."""

    mission: Mission
    dispersions: dict[Any, Distribution]
    seed: int
    cases: int
    tile: int


class Tiles:
    """An `Order` made ready on each of `devices`: programs, and what they share."""

    def __init__(self, order: Order, devices: Any = None):
        self.order = order
        self.devices = devices or jax.local_devices()
        self.count = -(-order.cases // order.tile)
        mission, dispersions = order.mission, order.dispersions
        prepared = _prepare(mission, dispersions)
        centre, covariance = linear_covariance(mission, dispersions, prepared)
        self.centre, self.covariance = np.asarray(centre), np.asarray(covariance)
        # What is not an array (a disturbance given as a function, say) is part of the program.
        given, rest = eqx.partition((mission, dispersions, prepared), eqx.is_array)
        leaves, self._treedef = jax.tree_util.tree_flatten(rest)
        self._leaves = tuple(leaves)
        key = jax.random.key(order.seed)
        self._given = [jax.device_put((given, key), device) for device in self.devices]

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities whose statistics are kept."""
        ends = ("final_time",) if self.order.mission.law.decides_end else ()
        return (*self.order.mission.plant.state_names, *ends)

    @functools.cached_property
    def reference(self) -> tuple[np.ndarray, np.ndarray]:
        """Of each quantity, the undispersed flight's value and a rough size of its deviations."""
        size = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        size = np.where(size > 0, size, 1.0)
        if not self.order.mission.law.decides_end:
            return self.centre, size
        flight = eqx.filter_jit(simulate)(self.order.mission, jax.random.key(0), "ends")
        end = float(flight.final_time)
        return np.append(self.centre, end), np.append(size, abs(end) * 1e-3)

    def rows(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...], Any]]:
        """Dimensions, shape and type of what each case leaves."""
        one = _program(jax.default_backend()).eval_shape(*self._arguments(0, 0))
        described = {}
        for name, a in one.items():
            dims = ("state",) if name in ("initial_state", "final_state") else None
            dims = tuple(f"{name}:{j}" for j in range(a.ndim - 1)) if dims is None else dims
            described[name] = (("case", *dims), a.shape[1:], a.dtype)
        return described

    def _arguments(self, index: Any, device: int) -> tuple:
        given, key = self._given[device]
        return given, key, jnp.asarray(index), self._leaves, self._treedef, self.order.tile

    def fly(self, index: int) -> dict[str, np.ndarray]:
        """Every row of tile `index`; those beyond the last case are cut off."""
        # What was put on a device is flown there.
        device = index % len(self.devices)
        program = _program(jax.default_backend())
        rows = jax.device_get(program(*self._arguments(index, device)))
        live = min(self.order.tile, self.order.cases - index * self.order.tile)
        return {name: np.asarray(values)[:live] for name, values in rows.items()}

    def chunk(self, parts: list[dict[str, np.ndarray]], each: int) -> tuple[dict, dict]:
        """Rows of at most `each` tiles one after another, and their sums for a Tally."""
        centre, scale = self.reference
        k = len(self.names)
        sums = {
            "moments": np.zeros((each, 1 + k + k * k)),
            "histogram": np.zeros((k, BINS), np.int64),
            "codes": np.zeros(len(RESULTS._name_to_item), np.int64),  # pyright: ignore
        }
        for i, rows in enumerate(parts):
            good = rows["result"] == code(RESULTS.successful)
            values = rows["final_state"][good].astype(float)
            if "final_time" in rows:
                values = np.column_stack([values, rows["final_time"][good]])
            deviations = values - centre[None]
            sums["moments"][i] = tile_moments(deviations)
            sums["codes"] += np.bincount(rows["result"], minlength=len(sums["codes"]))
            count_in(sums["histogram"], deviations, scale)
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}, sums


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
    dispersions: dict[Any, Distribution],
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
            "result": flight.result._value,
            **{f"draw:{path}": values for path, values in draws.items()},
            **ends,
        }

    return jax.vmap(fly)(index * tile + jnp.arange(tile))


def code(item: RESULTS) -> int:
    """The number by which a result is stored."""
    return int(item._value)  # pyright: ignore


def message(number: int) -> str:
    """The name of a stored result."""
    for name in RESULTS._name_to_item:  # pyright: ignore
        if code(getattr(RESULTS, name)) == number:
            return name
    return f"code {number}"
