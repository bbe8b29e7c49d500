"""Linear covariance of a closed loop: what the dispersions do to first order."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Prepared, simulate
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.miss import end_errors
from jaxguide.montecarlo.rollouts import apply, draw, leaf_at, ordered, spread


def linear_covariance(
    mission: Mission, dispersions: dict[Any, Distribution], prepared: Prepared | None = None
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Final state of the undispersed flight and the covariance of the final state about it.

    The final state's Jacobian with respect to every dispersed quantity, through the same gains,
    holds and integrator as the flights, sandwiches their covariance. Sensor noise is not included.
    `prepared`: `shared(mission, dispersions)` if at hand.

    **Error:** first order in the dispersions; a sweep beside it shows what is left.
    """
    ends, parts = linear_parts(mission, dispersions, prepared)
    n = mission.plant.n
    return ends[:n], jnp.sum(parts, axis=0)[:n, :n]


@eqx.filter_jit
def linear_parts(
    mission: Mission, dispersions: dict[Any, Distribution], prepared: Prepared | None = None
) -> tuple[Float[Array, " k"], Float[Array, "part k k"]]:
    """The undispersed end, the final state and then its `end_errors`, and what each part of the
    dispersions adds to its covariance. The parts are those of `part_names`."""
    shapes = jax.eval_shape(lambda: draw(mission, dispersions, jax.random.key(0)))
    zeros = {path: jnp.zeros(s.shape, s.dtype) for path, s in shapes.items()}

    def end(draws: dict[str, Array]) -> tuple[Array, Array]:
        flown = apply(mission, draws)
        flight = simulate(flown, jax.random.key(0), "ends", prepared)
        errors = end_errors(flown, flight.final_state, flight.final_time)
        both = jnp.concatenate([flight.final_state, errors])
        return both, both

    jacobians, ends = jax.jacfwd(end, has_aux=True)(zeros)
    parts = [jnp.zeros((0, ends.size, ends.size), ends.dtype)]
    for (paths, distribution), (_, covariance) in zip(
        ordered(dispersions), spread(mission, dispersions), strict=True
    ):
        flat = jnp.concatenate([jacobians[p].reshape(ends.size, -1) for p in paths], axis=1)
        covariance = covariance.astype(ends.dtype)
        if distribution.independent:
            columns = flat.T * jnp.sqrt(jnp.diag(covariance))[:, None]
            parts.append(columns[:, :, None] * columns[:, None, :])
        else:
            parts.append((flat @ covariance @ flat.T)[None])
    return ends, jnp.concatenate(parts)


def part_names(mission: Mission, dispersions: dict[Any, Distribution]) -> tuple[str, ...]:
    """A name for each part: an entry of a leaf, or a whole set of entries that are correlated."""
    names: list[str] = []
    for paths, distribution in ordered(dispersions):
        if distribution.independent:
            names += [name for path in paths for name in entry_names(mission, path)]
        else:
            names.append(", ".join(paths))
    return tuple(names)


def entry_names(mission: Mission, path: str) -> list[str]:
    """A name for each entry of the leaf at `path`."""
    leaf = leaf_at(mission, path)
    if leaf.ndim == 0:
        return [path]
    inner = [str(i) for i in range(leaf.size)]
    if path == "initial_state":
        inner = list(mission.plant.state_names)
    return [f"{path}[{name}]" for name in inner]
