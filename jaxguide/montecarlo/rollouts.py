"""`jg.rollouts`: a batch of dispersed flights, pure and differentiable."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxguide.flight.mission import Mission, with_leaf
from jaxguide.flight.simulate import Flight, Prepared, prepare, simulate
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.sampling import points


def draw(
    mission: Mission, dispersions: dict[Any, Distribution], key: Array, u: Array | None = None
) -> dict[str, Array]:
    """One case's deviations, by path. Each path has its own stream, so adding one moves no other.

    `u` (dimensions,): the case's point on the unit cube, by which it is drawn instead of by `key`.

    A tuple of paths is drawn as one vector, their leaves one after another, so that they may be
    correlated (`jg.MultivariateNormal`).

    **Raises:** `ValueError` for a path that is not one array of the mission, or that comes twice.
    """
    draws: dict[str, Array] = {}
    used = 0
    for paths, distribution in ordered(dispersions):
        leaves = [leaf_at(mission, path) for path in paths]
        stream = jax.random.fold_in(key, _hash(" ".join(paths)))
        whole = leaves[0]
        if len(paths) > 1:
            whole = jnp.concatenate([leaf.reshape(-1) for leaf in leaves])
        at = None if u is None else u[used : used + whole.size].reshape(whole.shape)
        at = None if at is None else at.astype(whole.dtype)
        used += whole.size
        deviation = distribution.deviation(stream, whole, at)
        cuts = np.cumsum([leaf.size for leaf in leaves])[:-1]
        parts = jnp.split(deviation, cuts) if len(paths) > 1 else [deviation]
        for path, leaf, part in zip(paths, leaves, parts, strict=True):
            if path in draws:
                raise ValueError(f"dispersions: {path!r} is drawn twice; name each leaf once.")
            draws[path] = part.reshape(leaf.shape)
    return draws


def dimensions(mission: Mission, dispersions: dict[Any, Distribution]) -> int:
    """Numbers that are drawn for a case."""
    return sum(leaf_at(mission, path).size for paths, _ in ordered(dispersions) for path in paths)


def spread(mission: Mission, dispersions: dict[Any, Distribution]) -> list[tuple]:
    """(paths, covariance of their flattened deviations) of each dispersion."""
    out = []
    for paths, distribution in ordered(dispersions):
        leaves = [leaf_at(mission, path) for path in paths]
        whole = leaves[0]
        if len(paths) > 1:
            whole = jnp.concatenate([leaf.reshape(-1) for leaf in leaves])
        out.append((paths, distribution.spread(whole)))
    return out


def ordered(dispersions: dict[Any, Distribution]) -> list[tuple[tuple[str, ...], Distribution]]:
    """By their paths, each a tuple."""
    named = {(k,) if isinstance(k, str) else tuple(k): v for k, v in dispersions.items()}
    return sorted(named.items(), key=lambda item: item[0])


def apply(mission: Mission, draws: dict[str, Array]) -> Mission:
    """`mission` with each drawn deviation added to its leaf."""
    for path, deviation in draws.items():
        mission = with_leaf(mission, path, lambda leaf, d=deviation: leaf + d)
    return mission


def rollouts(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    keys: Array,
    save: str = "ends",
    sampling: str = "random",
) -> Flight:
    """Flies one dispersed case per key.

    **Arguments:** `dispersions`: dotted path in the mission ("initial_state", "plant.thrust",
    "sensor.noise"), or several as a tuple -> distribution of the deviation; `keys` (B,): one PRNG
    key a case; `save`: "ends" (default) or "samples"; `sampling`: "random", or "latin_hypercube" or
    "sobol" to spread the B cases evenly over their distributions (randomised by the first key).

    **Returns:** a Flight whose arrays have a leading case axis. A case that fails is marked in its
    own `.result`; the others are untouched.
    """

    prepared = shared(mission, dispersions)
    spread_by = points(sampling, keys[0], dimensions(mission, dispersions), keys.shape[0])

    def fly(key: Array, case: Array) -> Flight:
        k_draw, k_noise = jax.random.split(key)
        u = None if spread_by is None else spread_by(case, mission.initial_state.dtype)
        flown = apply(mission, draw(mission, dispersions, k_draw, u))
        return simulate(flown, k_noise, save, prepared)

    return jax.vmap(fly)(keys, jnp.arange(keys.shape[0]))


def case_key(seed: Any, case: Any) -> Array:
    """The PRNG key of case `case` of a sweep: (seed, case) and nothing else."""
    key = seed if isinstance(seed, jax.Array) else jax.random.key(seed)
    return jax.random.fold_in(key, case)


def rerun(
    mission: Mission,
    dispersions: dict[Any, Distribution],
    seed: int,
    case: int,
    sampling: str = "random",
    cases: int | None = None,
) -> Flight:
    """Flies case `case` of a sweep with this `seed` again, with its history.

    `sampling`, and for "latin_hypercube" `cases`: those of the sweep.

    **Error:** a sweep's program may round differently: its final state to 1e-12 or so, relative.

    **Raises:** `ValueError` without the `cases` that a Latin hypercube needs.
    """
    if sampling == "latin_hypercube" and cases is None:
        raise ValueError("rerun: a Latin hypercube depends on its number of cases; pass cases=.")
    size = dimensions(mission, dispersions)
    spread_by = points(sampling, case_key(seed, 0), size, case + 1 if cases is None else cases)
    u = None if spread_by is None else spread_by(case, mission.initial_state.dtype)
    k_draw, k_noise = jax.random.split(case_key(seed, case))
    flown = apply(mission, draw(mission, dispersions, k_draw, u))
    return simulate(flown, k_noise, "samples", shared(mission, dispersions))


def shared(mission: Mission, dispersions: dict[Any, Distribution]) -> Prepared | None:
    """What all cases have in common, unless the law or its times are themselves dispersed."""
    own = ("law", "sample_interval", "initial_time", "final_time")
    if any(path.split(".")[0] in own for paths, _ in ordered(dispersions) for path in paths):
        return None
    return prepare(mission)


def leaf_at(mission: Mission, path: str) -> Array:
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
