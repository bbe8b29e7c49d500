"""Some cases of a sweep flown again with their whole histories. Host only."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, Prepared, simulate
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.rollouts import shared
from jaxguide.montecarlo.sampling import Points
from jaxguide.sweeping.tiles import Order, dispersed, points_of

_LANES = 16  # flown together, the last ones filled up: one program for any number of cases


def chosen(results: np.ndarray, successful: int, histories: int, failures: int) -> np.ndarray:
    """The first `histories` cases, and the first `failures` of those that failed.

    Cases are alike before they are flown, so the first are as good a sample as any, and the same
    wherever the sweep ends.
    """
    first = np.arange(min(histories, len(results)))
    failed = np.flatnonzero(results != successful)[:failures]
    return np.union1d(first, failed).astype(np.int64)


def in_full(order: Order, cases: np.ndarray) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Dimensions and values of `case`, `result` (history,), `t` (history, instant), `x`, `u`."""
    if not len(cases):
        return {}
    mission, dispersions = order.mission, order.dispersions
    key = jax.random.key(order.seed)
    spread_by = points_of(order)
    prepared = eqx.filter_jit(shared)(mission, dispersions)
    padded = np.append(cases, np.full(-len(cases) % _LANES, cases[-1]))
    flown = [
        jax.device_get(_fly(mission, dispersions, prepared, spread_by, key, jnp.asarray(some)))
        for some in padded.reshape(-1, _LANES)
    ]
    joined = lambda of: np.concatenate([np.asarray(of(f)) for f in flown])[: len(cases)]
    return {
        "case": (("history",), cases),
        "result": (("history",), joined(lambda f: f.result._value)),
        "t": (("history", "instant"), joined(lambda f: f.t)),
        "x": (("history", "instant", "state"), joined(lambda f: f.x)),
        "u": (("history", "sample", "control"), joined(lambda f: f.u)),
    }


@eqx.filter_jit
def _fly(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    prepared: Prepared | None,
    spread_by: Points | None,
    key: Array,
    cases: Array,
) -> Flight:
    def fly(case: Array) -> Flight:
        flown, _, k_noise = dispersed(mission, dispersions, spread_by, key, case)
        return simulate(flown, k_noise, "samples", prepared)

    return jax.vmap(fly)(cases)
