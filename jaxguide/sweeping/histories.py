"""Some cases of a sweep flown again with their whole histories. Host only."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, Prepared, simulate
from jaxguide.host.executables import kept
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.sampling import Points
from jaxguide.sweeping.tiles import Order, dispersed_case, lowered, points_of, prepared_of

_LANES = 16  # cases flown together; a last, short group is filled up: one program for any number


def cases_in_full(
    results: Int[np.ndarray, " case"], successful: int, histories: int, failures: int
) -> Int[np.ndarray, " history"]:
    """The first `histories` cases, and the first `failures` of those that failed.

    Cases are independent and distributed alike, so the first are as good a sample as any, and the
    same wherever the sweep ends.

    **Arguments:** `results`: codes of all cases; `successful`: the code of success.
    """
    first = np.arange(min(histories, len(results)))
    failed = np.flatnonzero(results != successful)[:failures]
    return np.union1d(first, failed).astype(np.int64)


def in_full(order: Order, cases: np.ndarray) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Name -> dimensions and values of the flights of `cases`, with their histories.

    `case`, `result` (history,); `t` (history, instant); `x` (history, instant, state); `u`
    (history, sample, control). Empty without cases.
    """
    if not len(cases):
        return {}
    arguments = _arguments(order)
    padded = np.append(cases, np.full(-len(cases) % _LANES, cases[-1]))
    flights = [
        jax.device_get(_fly_in_full(*arguments, jnp.asarray(group)))
        for group in padded.reshape(-1, _LANES)
    ]
    joined = lambda part: np.concatenate([np.asarray(part(f)) for f in flights])[: len(cases)]
    return {
        "case": (("history",), cases),
        "result": (("history",), joined(lambda f: f.result._value)),
        "t": (("history", "instant"), joined(lambda f: f.t)),
        "x": (("history", "instant", "state"), joined(lambda f: f.x)),
        "u": (("history", "sample", "control"), joined(lambda f: f.u)),
    }


def program_in_full(order: Order) -> str:
    """StableHLO text of the program of `in_full`: lowered, not compiled."""
    return lowered(_fly_in_full, *_arguments(order), jnp.asarray(np.zeros(_LANES, np.int64)))


def _arguments(
    order: Order,
) -> tuple[Mission, dict[Any, Distribution], Prepared | None, Points | None, Array]:
    mission, dispersions, seeded = order.mission, order.dispersions, jax.random.key(order.seed)
    return mission, dispersions, prepared_of(order), points_of(order), seeded


@kept
def _fly_in_full(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    prepared: Prepared | None,
    spread_by: Points | None,
    key: Array,
    cases: Array,
) -> Flight:
    def fly(case: Array) -> Flight:
        deviated, _, k_noise = dispersed_case(mission, dispersions, spread_by, key, case)
        return simulate(deviated, k_noise, "samples", prepared)

    return jax.vmap(fly)(cases)
