"""`jg.rollouts`: a batch of dispersed flights, pure and differentiable."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.flight.mission import Mission, with_leaf
from jaxguide.flight.simulate import Flight, Prepared, prepare, simulate
from jaxguide.montecarlo.dispersions import Distribution


def draw(mission: Mission, dispersions: dict[str, Distribution], key: Array) -> dict[str, Array]:
    """One case's deviations, by path. Each path has its own stream, so adding one moves no other.

    **Raises:** `ValueError` for a path that is not one array of the mission.
    """
    draws = {}
    for path, distribution in sorted(dispersions.items()):
        leaf = _leaf(mission, path)
        stream = jax.random.fold_in(key, _hash(path))
        draws[path] = distribution.sample(stream, leaf.shape, leaf.dtype)
    return draws


def apply(mission: Mission, draws: dict[str, Array]) -> Mission:
    """`mission` with each drawn deviation added to its leaf."""
    for path, deviation in draws.items():
        mission = with_leaf(mission, path, lambda leaf, d=deviation: leaf + d)
    return mission


def rollouts(
    mission: Mission,
    dispersions: dict[str, Distribution],
    keys: Array,
    save: str = "ends",
) -> Flight:
    """Flies one dispersed case per key.

    **Arguments:** `dispersions`: dotted path in the mission ("initial_state", "plant.thrust",
    "sensor.noise") -> distribution of the deviation; `keys` (B,): one PRNG key a case; `save`:
    "ends" (default) or "samples".

    **Returns:** a Flight whose arrays have a leading case axis. A case that fails is marked in its
    own `.result`; the others are untouched.
    """

    prepared = shared(mission, dispersions)

    def fly(key: Array) -> Flight:
        k_draw, k_noise = jax.random.split(key)
        flown = apply(mission, draw(mission, dispersions, k_draw))
        return simulate(flown, k_noise, save, prepared)

    return jax.vmap(fly)(keys)


def shared(mission: Mission, dispersions: dict[str, Distribution]) -> Prepared | None:
    """What all cases have in common, unless the law or its times are themselves dispersed."""
    own = ("law", "sample_interval", "initial_time", "final_time")
    if any(path.split(".")[0] in own for path in dispersions):
        return None
    return prepare(mission)


def _leaf(mission: Mission, path: str) -> Array:
    found: list[Array] = []

    def keep(leaf: Any) -> Any:
        found.append(jnp.asarray(leaf))
        return leaf

    with_leaf(mission, path, keep)
    return found[0]


def _hash(path: str) -> int:
    """A fixed 31-bit hash of a path (Python's own is salted)."""
    value = 0
    for byte in path.encode():
        value = (value * 131 + byte) % (2**31 - 1)
    return value
