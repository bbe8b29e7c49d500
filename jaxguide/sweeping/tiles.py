"""Flights in tiles: a tile is as many cases as one program flies together, each in the lane that
its number gives, so that a case has the same bits in any sweep, chunk, device and process. Host
only.
"""

import functools
import json
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Prepared, simulate
from jaxguide.host.compilation import kept_hastily, kept_quickly
from jaxguide.host.executables import kept
from jaxguide.montecarlo.covariance import entry_names, linear_parts, part_names
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.miss import end_errors, miss_distance
from jaxguide.montecarlo.rollouts import (
    case_key,
    dimensions,
    draw,
    leaf_at,
    shared,
    sorted_by_path,
    with_deviations,
)
from jaxguide.montecarlo.sampling import Points, points
from jaxguide.sweeping import importance, ranking
from jaxguide.sweeping.tally import BINS, count_in, tile_moments
from jaxguide.types import RESULTS, code

# Cases flown together; their working set stays in a core's cache (by experiment on Earth-Mars).
TILE = 4096


class Order(NamedTuple):
    """A sweep to be flown: all that the bits of a case depend on, and the number of cases.

    `dispersions`: path (or paths, as a tuple) -> distribution; `tile`: cases of a tile; `sampling`:
    one of `jaxguide.montecarlo.sampling.SAMPLINGS`.
    """

    mission: Mission
    dispersions: dict[Any, Distribution]
    seed: int
    cases: int
    tile: int
    sampling: str = "random"


class Tiles:
    """An `Order` made ready to be flown: its programs and their shared arguments on each of
    `devices` (default: all local ones)."""

    def __init__(self, order: Order, devices: Any = None):
        self.order = order
        self.devices = devices or jax.local_devices()
        self.count = -(-order.cases // order.tile)
        self._first: dict[str, np.ndarray] | None = None
        mission, dispersions = order.mission, order.dispersions
        self._prepared = prepared_of(order)
        paths = [path for group, _ in sorted_by_path(dispersions) for path in group]
        self._leaves_drawn = {path: np.asarray(leaf_at(mission, path)) for path in paths}
        seeded = jax.random.key(order.seed)
        spread_by = points_of(order)
        # Arrays are arguments of the program; all else (a disturbance given as a function, say) is
        # a part of it.
        whole = (mission, dispersions, self._prepared, spread_by, seeded)
        given, rest = eqx.partition(whole, eqx.is_array)
        self._given = [eqx.combine(jax.device_put(given, device), rest) for device in self.devices]

    @functools.cached_property
    def _linear(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The undispersed end, the parts of its linear covariance and its time, by
        `linear_parts`."""
        order = self.order
        return jax.device_get(linear_parts(order.mission, order.dispersions, self._prepared))

    @property
    def centre(self) -> np.ndarray:
        """(n,): final state of the undispersed flight."""
        return self._linear[0][: self.order.mission.plant.n]

    @property
    def covariance(self) -> np.ndarray:
        """(n, n): linear covariance of the final state."""
        n = self.order.mission.plant.n
        return self._linear[1].sum(axis=0)[:n, :n]

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities whose statistics are kept: states, the miss if the plant has endpoint
        constraints, the final time if the law decides it."""
        miss = ("miss",) if self._targets else ()
        ends = ("final_time",) if self.order.mission.law.decides_end else ()
        return (*self.order.mission.plant.state_names, *miss, *ends)

    @property
    def _targets(self) -> int:
        """Number of endpoint constraints."""
        return self._linear[1].shape[-1] - self.order.mission.plant.n

    @functools.cached_property
    def reference(self) -> tuple[np.ndarray, np.ndarray]:
        """(k,), (k,): for each of `names`, its value in the undispersed flight and a rough size of
        its deviations: the standard deviation of the linear covariance, 1 where that is zero."""
        n = self.order.mission.plant.n
        variance = np.maximum(np.diag(self._linear[1].sum(axis=0)), 0.0).astype(float)
        centre, size = self.centre.astype(float), np.sqrt(variance[:n])
        if self._targets:
            centre, size = np.append(centre, 0.0), np.append(size, np.sqrt(variance[n:].sum()))
        size = np.where(size > 0, size, 1.0)
        if not self.order.mission.law.decides_end:
            return centre, size
        end = float(self._linear[2])
        return np.append(centre, end), np.append(size, abs(end) * _ROUGH)

    @functools.cached_property
    def bins(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges (d, SLOTS - 1) of the bins of every drawn number, and a size (k,) of the deviations
        of every quantity, both from tile 0, its lanes beyond the last case included.

        The linear covariance gives no size where a law cancels all first-order effects.
        """
        rows = self._first = self._whole(0)
        good = rows["result"] == code(RESULTS.successful)
        size = self._deviations(rows)[good].std(axis=0) if good.any() else np.ones(len(self.names))
        return importance.edges_of(self._draws(rows)), np.where(size > 0, size, 1.0)

    @property
    def linear_shares(self) -> dict[str, Any]:
        """State -> part of the dispersions -> its share of the state's linear variance."""
        mission, dispersions = self.order.mission, self.order.dispersions
        states = tuple(mission.plant.state_names)
        shares = importance.linear_shares(self._linear[1])[:, : len(states)]
        return importance.by_outcome(part_names(mission, dispersions), states, shares)

    @property
    def drawn_names(self) -> tuple[str, ...]:
        """A name for every drawn number, such as "plant.thrust" or "initial_state[v]"."""
        mission = self.order.mission
        return tuple(name for path in self._leaves_drawn for name in entry_names(mission, path))

    def rows(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...], Any]]:
        """Name -> dimensions, shape and type of each variable that is stored of a case."""
        one = _program(jax.default_backend()).eval_shape(*self._arguments(0, 0))
        described = {}
        for name, a in one.items():
            dims = ("state",) if name in ("initial_state", "final_state") else None
            leaf = name.partition(":")[2]
            dims = tuple(f"{leaf}:{j}" for j in range(a.ndim - 1)) if dims is None else dims
            described[name] = (("case", *dims), a.shape[1:], a.dtype)
        return described

    def programs(self) -> dict[str, str]:
        """StableHLO text, without source locations, of every program that the numbers of a sweep
        come from: lowered, not compiled.

        The text of a program is the same in every process and on any number of devices.
        """
        order, tile = self.order, _program(jax.default_backend())
        texts = {
            "prepare": lowered(_prepare, order.mission, order.dispersions),
            "covariance": lowered(linear_parts, order.mission, order.dispersions, self._prepared),
            "tile": lowered(tile, *self._arguments(0, 0)) + json.dumps(compiler_options()),
        }
        if order.sampling != "random":
            texts["points"] = lowered(_points, *_of_points(order))
        return texts

    def _arguments(self, index: Any, device: int) -> tuple:
        return *self._given[device], jnp.asarray(index), self.order.tile

    def _whole(self, index: int) -> dict[str, np.ndarray]:
        # A program runs on the device that its arguments lie on.
        device = index % len(self.devices)
        rows = jax.device_get(_program(jax.default_backend())(*self._arguments(index, device)))
        return {name: np.asarray(values) for name, values in rows.items()}

    def fly(self, index: int) -> dict[str, np.ndarray]:
        """Name -> values (case, ...) of tile `index`, without lanes beyond the last case."""
        live = min(self.order.tile, self.order.cases - index * self.order.tile)
        rows = None
        if index == 0:  # flown for its bins
            rows, self._first = self._first, None
        rows = self._whole(index) if rows is None else rows
        return {name: values[:live] for name, values in rows.items()}

    def _draws(self, rows: dict[str, np.ndarray]) -> np.ndarray:
        """(cases, d): every drawn number, in the order of `drawn_names`."""
        parts = [rows[f"draw:{p}"].reshape(len(rows["result"]), -1) for p in self._leaves_drawn]
        return np.concatenate(parts, axis=1, dtype=float) if parts else np.zeros((0, 0))

    def _deviations(self, rows: dict[str, np.ndarray]) -> np.ndarray:
        """(cases, k): every quantity of `names`, less its reference."""
        more = [rows[name] for name in ("miss", "final_time") if name in rows]
        return np.column_stack([rows["final_state"], *more]).astype(float) - self.reference[0][None]

    def chunk(self, parts: list[dict[str, np.ndarray]], first: int, each: int) -> tuple[dict, dict]:
        """Rows and sums of a chunk: at most `each` tiles, of which `first` is the first.

        **Arguments:** `parts`: what `fly` gave for each tile, in order.

        **Returns:** name -> values (case, ...); and name -> sums, as `Totals` adds them up.

        **Raises:** `RuntimeError` where a case was not flown with the deviations drawn for it.
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
            # Without endpoint constraints, the worst case ends furthest from the undispersed one.
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
        """Each flown leaf must be that of the mission plus its draw, up to rounding."""
        for path, leaf in self._leaves_drawn.items():
            drawn, applied = rows[f"draw:{path}"], rows[_applied(path)]
            # One rounding of the sum; one of the draw where XLA contracts its product into the sum.
            allowed = np.spacing(np.abs(applied)) + np.spacing(np.abs(drawn))
            wrong = ~(np.abs(applied - (leaf[None] + drawn)) <= allowed)
            if wrong.any():
                i = int(np.argwhere(wrong)[0][0])
                raise RuntimeError(
                    f"sweep: case {start + i} was flown with {path} = {applied[i]}, but {drawn[i]} "
                    f"was drawn to be added to {leaf}. This chunk was not stored; this is a fault "
                    "of the program, please report it."
                )


def _applied(path: str) -> str:
    return path if path == "initial_state" else f"applied:{path}"


_ROUGH = 1e-3  # of the final time: a rough size of its deviations, only for bins of a histogram


def lowered(program: Any, *arguments: Any) -> str:
    """StableHLO text, without source locations, of a jitted `program` for these arguments."""
    return program.lower(*arguments).as_text()


def compiler_options() -> dict[str, Any]:
    """XLA's options for the program of a tile: on CPU, the full width of the vector units."""
    return {"xla_cpu_prefer_vector_width": 512} if jax.default_backend() == "cpu" else {}


_prepare = kept_hastily(shared)
_points = kept_quickly(points)


def prepared_of(order: Order) -> Prepared | None:
    """The sample times and prepared law that its cases share; None if each has its own."""
    return _prepare(order.mission, order.dispersions)


def points_of(order: Order) -> Points | None:
    """The points of its cases on the unit cube; None for random ones."""
    return None if order.sampling == "random" else _points(*_of_points(order))


def _of_points(order: Order) -> tuple:
    size = dimensions(order.mission, order.dispersions)
    return order.sampling, case_key(order.seed, 0), size, order.cases


@functools.cache
def _program(backend: str) -> Any:
    """The jitted flight of one tile: one function for all sweeps, so that the second compiles
    nothing."""
    del backend  # decides the options, so it is in the key of the cache

    def tile_of(*given: Any) -> dict[str, Any]:
        return _fly_tile(*given)

    return kept(tile_of, compiler_options)


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
        deviated, draws, k_noise = dispersed_case(mission, dispersions, spread_by, key, case)
        flight = simulate(deviated, k_noise, "ends", prepared)
        # Of all cases the same unless the law decides it.
        ends = {"final_time": flight.final_time} if mission.law.decides_end else {}
        at_end = deviated, flight.final_state, flight.final_time
        if end_errors(*at_end).size:
            ends["miss"] = miss_distance(*at_end)
        others = [path for path in draws if path != "initial_state"]
        return {
            "initial_state": deviated.initial_state,
            "final_state": flight.final_state,
            "saturated": flight.saturated,
            "result": flight.result._value,
            **{f"draw:{path}": values for path, values in draws.items()},
            **{_applied(path): leaf_at(deviated, path) for path in others},
            **ends,
        }

    return jax.vmap(fly)(index * tile + jnp.arange(tile))


def dispersed_case(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    spread_by: Points | None,
    key: Array,
    case: Array,
) -> tuple[Mission, dict[str, Array], Array]:
    """The mission of one case with its deviations added, the deviations by path, and the key of its
    sensor's noise."""
    k_draw, k_noise = jax.random.split(case_key(key, case))
    u = None if spread_by is None else spread_by(case, mission.initial_state.dtype)
    draws = draw(mission, dispersions, k_draw, u)
    return with_deviations(mission, draws), draws, k_noise
