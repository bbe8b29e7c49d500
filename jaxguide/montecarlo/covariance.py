"""Linear covariance of a closed loop: the effect of the dispersions to first order."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Prepared, simulate
from jaxguide.host.compilation import kept_hastily
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.miss import end_errors
from jaxguide.montecarlo.rollouts import draw, leaf_at, sorted_by_path, spread, with_deviations


def linear_covariance(
    mission: Mission, dispersions: dict[Any, Distribution], prepared: Prepared | None = None
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    r"""Final state of the undispersed flight and the covariance of the final state about it.

    $P = J \Sigma J^T$: $J$ is the Jacobian of the final state by every dispersed number, through
    the same gains, holds and integrator as the flights; $\Sigma$ the covariance of these numbers.
    Sensor noise is not included.

    **Arguments:** `prepared`: `shared(mission, dispersions)` if at hand.

    **Returns:** the final state (n,) and its covariance (n, n), in units of the plant.

    **Error:** first order in the dispersions; the sampled covariance of a sweep shows the rest.
    """
    ends, parts, _ = linear_parts(mission, dispersions, prepared)
    n = mission.plant.n
    return ends[:n], jnp.sum(parts, axis=0)[:n, :n]


@kept_hastily
def linear_parts(
    mission: Mission, dispersions: dict[Any, Distribution], prepared: Prepared | None = None
) -> tuple[Float[Array, " k"], Float[Array, "part k k"], Float[Array, ""]]:
    """The end of the undispersed flight and the covariance that each part of the dispersions adds.

    **Returns:** the end (k,): the final state, then its `end_errors`; for each part, in the order
    of `part_names`, its share (k, k) of the covariance of the end; and the time of the end.
    """
    shapes = jax.eval_shape(lambda: draw(mission, dispersions, jax.random.key(0)))
    zeros = {path: jnp.zeros(s.shape, s.dtype) for path, s in shapes.items()}

    def end(draws: dict[str, Array]) -> tuple[Array, tuple[Array, Array]]:
        deviated = with_deviations(mission, draws)
        flight = simulate(deviated, jax.random.key(0), "ends", prepared)
        errors = end_errors(deviated, flight.final_state, flight.final_time)
        both = jnp.concatenate([flight.final_state, errors])
        return both, (both, flight.final_time)

    jacobians, (ends, final_time) = jax.jacfwd(end, has_aux=True)(zeros)
    parts = [jnp.zeros((0, ends.size, ends.size), ends.dtype)]
    for (paths, distribution), (_, covariance) in zip(
        sorted_by_path(dispersions), spread(mission, dispersions), strict=True
    ):
        flat = jnp.concatenate([jacobians[p].reshape(ends.size, -1) for p in paths], axis=1)
        covariance = covariance.astype(ends.dtype)
        if distribution.independent:
            columns = flat.T * jnp.sqrt(jnp.diag(covariance))[:, None]
            parts.append(columns[:, :, None] * columns[:, None, :])
        else:
            parts.append((flat @ covariance @ flat.T)[None])
    return ends, jnp.concatenate(parts), final_time


def part_names(mission: Mission, dispersions: dict[Any, Distribution]) -> tuple[str, ...]:
    """A name for each part of the dispersions: one entry of a leaf, or, where the entries are
    correlated, all leaves of the distribution."""
    names: list[str] = []
    for paths, distribution in sorted_by_path(dispersions):
        if distribution.independent:
            names += [name for path in paths for name in entry_names(mission, path)]
        else:
            names.append(", ".join(paths))
    return tuple(names)


def entry_names(mission: Mission, path: str) -> list[str]:
    """A name for each entry of the leaf at `path`: "initial_state[v]", or the path of a scalar."""
    leaf = leaf_at(mission, path)
    if leaf.ndim == 0:
        return [path]
    inner = [str(i) for i in range(leaf.size)]
    if path == "initial_state":
        inner = list(mission.plant.state_names)
    return [f"{path}[{name}]" for name in inner]
