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
from jaxguide.montecarlo.covariance import entry_names, linear_parts, part_names
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.miss import end_errors, miss_distance
from jaxguide.montecarlo.rollouts import apply, case_key, dimensions, draw, leaf_at, ordered, shared
from jaxguide.montecarlo.sampling import Points, points
from jaxguide.sweeping import importance, ranking
from jaxguide.sweeping.tally import BINS, count_in, tile_moments
from jaxguide.types import RESULTS, code

# Lanes flown together: their working set stays in a core's cache (chosen by experiment).
TILE = 4096


class Order(NamedTuple):
    """What is to be flown: all that a case's bits depend on, and how many cases there are."""

    mission: Mission
    dispersions: dict[Any, Distribution]
    seed: int
    cases: int
    tile: int
    sampling: str = "random"


class Tiles:
    """An `Order` made ready on each of `devices`: programs, and what they share."""

    def __init__(self, order: Order, devices: Any = None):
        self.order = order
        self.devices = devices or jax.local_devices()
        self.count = -(-order.cases // order.tile)
        mission, dispersions = order.mission, order.dispersions
        prepared = _prepare(mission, dispersions)
        ends, parts = linear_parts(mission, dispersions, prepared)
        n = mission.plant.n
        self.centre, self._parts = np.asarray(ends)[:n], np.asarray(parts)
        self.covariance = self._parts.sum(axis=0)[:n, :n]
        paths = [path for group, _ in ordered(dispersions) for path in group]
        self._leaves_drawn = {path: np.asarray(leaf_at(mission, path)) for path in paths}
        seeded = jax.random.key(order.seed)
        spread_by = points_of(order)
        # What is not an array (a disturbance given as a function, say) is part of the program.
        given, rest = eqx.partition((mission, dispersions, prepared, spread_by), eqx.is_array)
        leaves, self._treedef = jax.tree_util.tree_flatten(rest)
        self._leaves = tuple(leaves)
        self._given = [jax.device_put((given, seeded), device) for device in self.devices]

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities whose statistics are kept."""
        miss = ("miss",) if self._targets else ()
        ends = ("final_time",) if self.order.mission.law.decides_end else ()
        return (*self.order.mission.plant.state_names, *miss, *ends)

    @property
    def _targets(self) -> int:
        """Components of the endpoint constraints."""
        return self._parts.shape[-1] - self.order.mission.plant.n

    @functools.cached_property
    def reference(self) -> tuple[np.ndarray, np.ndarray]:
        """Of each quantity, the undispersed flight's value and a rough size of its deviations."""
        n = self.order.mission.plant.n
        variance = np.maximum(np.diag(self._parts.sum(axis=0)), 0.0).astype(float)
        centre, size = self.centre.astype(float), np.sqrt(variance[:n])
        if self._targets:
            centre, size = np.append(centre, 0.0), np.append(size, np.sqrt(variance[n:].sum()))
        size = np.where(size > 0, size, 1.0)
        if not self.order.mission.law.decides_end:
            return centre, size
        flight = eqx.filter_jit(simulate)(self.order.mission, jax.random.key(0), "ends")
        end = float(flight.final_time)
        return np.append(centre, end), np.append(size, abs(end) * 1e-3)

    @functools.cached_property
    def bins(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges of the bins of every drawn number, and a size of every quantity's deviations: by
        tile 0, its lanes beyond the last case too. Where a law takes all first-order effects away,
        linear covariance knows no size."""
        rows = self._whole(0)
        good = rows["result"] == code(RESULTS.successful)
        size = self._deviations(rows)[good].std(axis=0) if good.any() else np.ones(len(self.names))
        return importance.edges_of(self._draws(rows)), np.where(size > 0, size, 1.0)

    @property
    def linear_shares(self) -> dict[str, Any]:
        """Of every state's variance to first order, each part's share."""
        mission, dispersions = self.order.mission, self.order.dispersions
        states = tuple(mission.plant.state_names)
        shares = importance.linear_shares(self._parts)[:, : len(states)]
        return importance.told(part_names(mission, dispersions), states, shares)

    @property
    def drawn_names(self) -> tuple[str, ...]:
        """A name for every drawn number."""
        mission = self.order.mission
        return tuple(name for path in self._leaves_drawn for name in entry_names(mission, path))

    def rows(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...], Any]]:
        """Dimensions, shape and type of what each case leaves."""
        one = _program(jax.default_backend()).eval_shape(*self._arguments(0, 0))
        described = {}
        for name, a in one.items():
            dims = ("state",) if name in ("initial_state", "final_state") else None
            leaf = name.partition(":")[2]
            dims = tuple(f"{leaf}:{j}" for j in range(a.ndim - 1)) if dims is None else dims
            described[name] = (("case", *dims), a.shape[1:], a.dtype)
        return described

    def _arguments(self, index: Any, device: int) -> tuple:
        given, key = self._given[device]
        return given, key, jnp.asarray(index), self._leaves, self._treedef, self.order.tile

    def _whole(self, index: int) -> dict[str, np.ndarray]:
        # What was put on a device is flown there.
        device = index % len(self.devices)
        rows = jax.device_get(_program(jax.default_backend())(*self._arguments(index, device)))
        return {name: np.asarray(values) for name, values in rows.items()}

    def fly(self, index: int) -> dict[str, np.ndarray]:
        """Every row of tile `index`; those beyond the last case are cut off."""
        live = min(self.order.tile, self.order.cases - index * self.order.tile)
        return {name: values[:live] for name, values in self._whole(index).items()}

    def _draws(self, rows: dict[str, np.ndarray]) -> np.ndarray:
        """(cases, d): every drawn number, in the order of `drawn_names`."""
        parts = [rows[f"draw:{p}"].reshape(len(rows["result"]), -1) for p in self._leaves_drawn]
        return np.concatenate(parts, axis=1, dtype=float) if parts else np.zeros((0, 0))

    def _deviations(self, rows: dict[str, np.ndarray]) -> np.ndarray:
        """(cases, k): every quantity of `names`, less its reference."""
        more = [rows[name] for name in ("miss", "final_time") if name in rows]
        return np.column_stack([rows["final_state"], *more]).astype(float) - self.reference[0][None]

    def chunk(self, parts: list[dict[str, np.ndarray]], first: int, each: int) -> tuple[dict, dict]:
        """Rows of at most `each` tiles from `first` on, one after another, and their sums.

        **Raises:** `RuntimeError` where a case was not flown with what was drawn for it.
        """
        scale, (edges, size) = self.reference[1], self.bins
        k = len(self.names)
        sums = {
            "moments": np.zeros((each, 1 + k + k * k)),
            "histogram": np.zeros((k, BINS), np.int64),
            "codes": np.zeros(len(RESULTS._name_to_item), np.int64),  # pyright: ignore
            "bins": np.zeros((len(edges), importance.SLOTS, 1 + k), np.int64),
            "unit": size,
        }
        tables = []
        for i, rows in enumerate(parts):
            start = (first + i) * self.order.tile
            self._check_applied(rows, start)
            good = rows["result"] == code(RESULTS.successful)
            deviations = self._deviations(rows)
            # Without endpoint constraints, what lies furthest from the undispersed end is worst.
            far = rows["miss"] if "miss" in rows else np.abs(deviations / scale[None]).max(axis=1)
            tables.append(ranking.worst(far.astype(float), start, rows["result"]))
            deviations = deviations[good]
            sums["moments"][i] = tile_moments(deviations)
            sums["codes"] += np.bincount(rows["result"], minlength=len(sums["codes"]))
            count_in(sums["histogram"], deviations / scale[None])
            if len(edges) and first + i < importance.TILES:
                sums["bins"] += importance.bin_sums(
                    self._draws(rows)[good], deviations / size[None], edges
                )
        sums["worst"] = ranking.merged(*tables)
        return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}, sums

    def _check_applied(self, rows: dict[str, np.ndarray], start: int) -> None:
        """What was flown is the leaf plus what was drawn, in the flight's own rounding."""
        for path, leaf in self._leaves_drawn.items():
            drawn, applied = rows[f"draw:{path}"], rows[_applied(path)]
            # One rounding of the sum, another of the draw where it was contracted into it.
            allowed = np.spacing(np.abs(applied)) + np.spacing(np.abs(drawn))
            wrong = ~(np.abs(applied - (leaf[None] + drawn)) <= allowed)
            if wrong.any():
                i = int(np.argwhere(wrong)[0][0])
                raise RuntimeError(
                    f"sweep: case {start + i} was flown with {path} = {applied[i]}, but {drawn[i]} "
                    f"was drawn to be added to {leaf}. Nothing of this chunk was kept; this is a "
                    "fault of the program, please report it."
                )


def _applied(path: str) -> str:
    return path if path == "initial_state" else f"applied:{path}"


def compiler_options() -> dict[str, Any]:
    """What XLA should do for flights: on CPU, use the full width of the vector units."""
    return {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}


_prepare = eqx.filter_jit(shared)
_points = eqx.filter_jit(points)


def points_of(order: Order) -> Points | None:
    """Where its cases lie."""
    if order.sampling == "random":
        return None
    size = dimensions(order.mission, order.dispersions)
    return _points(order.sampling, case_key(order.seed, 0), size, order.cases)


@functools.cache
def _program(backend: str) -> Any:
    """The compiled flight of one tile; one function, so that a second sweep compiles nothing."""
    del backend  # in the key of the cache, since it decides the options

    def tile_of(
        given: Any, key: Array, index: Array, leaves: tuple, treedef: Any, tile: int
    ) -> dict[str, Any]:
        rest = jax.tree_util.tree_unflatten(treedef, leaves)
        mission, dispersions, prepared, spread_by = eqx.combine(given, rest)
        return _fly_tile(mission, dispersions, prepared, spread_by, key, index, tile)

    return jax.jit(tile_of, static_argnums=(3, 4, 5), compiler_options=compiler_options())


def _fly_tile(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    prepared: Prepared | None,
    spread_by: Points | None,
    key: Array,
    index: Array,
    tile: int,
) -> dict[str, Any]:
    def fly(case: Array) -> dict[str, Any]:
        flown, draws, k_noise = dispersed(mission, dispersions, spread_by, key, case)
        flight = simulate(flown, k_noise, "ends", prepared)
        # The time of the end says something only where the law decides it.
        ends = {"final_time": flight.final_time} if mission.law.decides_end else {}
        at_end = flown, flight.final_state, flight.final_time
        if end_errors(*at_end).size:
            ends["miss"] = miss_distance(*at_end)
        others = [path for path in draws if path != "initial_state"]
        return {
            "initial_state": flown.initial_state,
            "final_state": flight.final_state,
            "saturated": flight.saturated,
            "result": flight.result._value,
            **{f"draw:{path}": values for path, values in draws.items()},
            **{_applied(path): leaf_at(flown, path) for path in others},
            **ends,
        }

    return jax.vmap(fly)(index * tile + jnp.arange(tile))


def dispersed(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    spread_by: Points | None,
    key: Array,
    case: Array,
) -> tuple[Mission, dict[str, Array], Array]:
    """The mission of one case, what was drawn for it, and the key of its noise."""
    k_draw, k_noise = jax.random.split(case_key(key, case))
    u = None if spread_by is None else spread_by(case, mission.initial_state.dtype)
    draws = draw(mission, dispersions, k_draw, u)
    return apply(mission, draws), draws, k_noise
