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
    """The deviations of one case, by path.

    Each path has its own random stream, so adding a dispersion changes no other draw.

    **Arguments:** `key`: the PRNG key of the case; `u` (dimensions,): the point of the case on the
    unit cube; if given, the draws are the quantiles at `u` instead of random numbers from `key`.

    A tuple of paths is drawn as one vector, their leaves one after another, so that they may be
    correlated (`jg.MultivariateNormal`).

    **Raises:** `ValueError` for a path that is not one array of the mission, or that comes twice.
    """
    draws: dict[str, Array] = {}
    used = 0
    for paths, distribution in sorted_by_path(dispersions):
        leaves = [leaf_at(mission, path) for path in paths]
        stream = jax.random.fold_in(key, _hash(" ".join(paths)))
        whole = _joined(leaves)
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
    """How many numbers are drawn for a case."""
    paths = (path for group, _ in sorted_by_path(dispersions) for path in group)
    return sum(leaf_at(mission, path).size for path in paths)


def spread(mission: Mission, dispersions: dict[Any, Distribution]) -> list[tuple]:
    """(paths, covariance matrix of their flattened deviations) of each dispersion."""
    out = []
    for paths, distribution in sorted_by_path(dispersions):
        leaves = [leaf_at(mission, path) for path in paths]
        out.append((paths, distribution.spread(_joined(leaves))))
    return out


def _joined(leaves: list[Array]) -> Array:
    """One leaf as it is; several as one vector."""
    return leaves[0] if len(leaves) == 1 else jnp.concatenate([v.reshape(-1) for v in leaves])


def sorted_by_path(
    dispersions: dict[Any, Distribution],
) -> list[tuple[tuple[str, ...], Distribution]]:
    """(paths, distribution) of each dispersion, sorted by path; a single path is a tuple of one."""
    named = {(k,) if isinstance(k, str) else tuple(k): v for k, v in dispersions.items()}
    return sorted(named.items(), key=lambda item: item[0])


def with_deviations(mission: Mission, draws: dict[str, Array]) -> Mission:
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
        deviated = with_deviations(mission, draw(mission, dispersions, k_draw, u))
        return simulate(deviated, k_noise, save, prepared)

    return jax.vmap(fly)(keys, jnp.arange(keys.shape[0]))


def case_key(seed: Any, case: Any) -> Array:
    """The PRNG key of case `case` of a sweep: a function of (seed, case) alone.

    **Arguments:** `seed`: an integer, or `jax.random.key` of it.
    """
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
    """Flies case `case` of a sweep with this `seed` again, and returns its whole history.

    **Arguments:** `sampling`, and for "latin_hypercube" `cases`: as they were in the sweep.

    **Error:** a sweep's program may round differently: the final states agree to about 1e-12 of
    their size (by experiment; the tests hold it).

    **Raises:** `ValueError` without the `cases` that a Latin hypercube needs.
    """
    if sampling == "latin_hypercube" and cases is None:
        raise ValueError("rerun: a Latin hypercube depends on its number of cases; pass cases=.")
    size = dimensions(mission, dispersions)
    spread_by = points(sampling, case_key(seed, 0), size, case + 1 if cases is None else cases)
    u = None if spread_by is None else spread_by(case, mission.initial_state.dtype)
    k_draw, k_noise = jax.random.split(case_key(seed, case))
    deviated = with_deviations(mission, draw(mission, dispersions, k_draw, u))
    return simulate(deviated, k_noise, "samples", shared(mission, dispersions))


def shared(mission: Mission, dispersions: dict[Any, Distribution]) -> Prepared | None:
    """The sample times and prepared law that all cases share; None if the law or its times are
    themselves dispersed, so that each case prepares its own."""
    own = ("law", "sample_interval", "initial_time", "final_time")
    if any(path.split(".")[0] in own for paths, _ in sorted_by_path(dispersions) for path in paths):
        return None
    return prepare(mission)


def leaf_at(mission: Mission, path: str) -> Array:
    """The array at a dotted `path` of the mission, such as "plant.thrust".

    **Raises:** `ValueError` for a path that is not one array of the mission.
    """
    found: list[Array] = []

    def keep(leaf: Any) -> Any:
        found.append(jnp.asarray(leaf))
        return leaf

    with_leaf(mission, path, keep)
    return found[0]


def _hash(path: str) -> int:
    """A 31-bit hash of a path, the same in every process (Python's own is salted).

    A polynomial in 131 modulo the Mersenne prime 2^31 - 1. Any fixed hash would serve, but another
    one would change all draws.
    """
    value = 0
    for byte in path.encode():
        value = (value * 131 + byte) % (2**31 - 1)
    return value
