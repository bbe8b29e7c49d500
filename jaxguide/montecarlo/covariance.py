"""Linear covariance of a closed loop: what the dispersions do to first order."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Prepared, simulate
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.rollouts import apply, draw, spread


@eqx.filter_jit
def linear_covariance(
    mission: Mission, dispersions: dict[Any, Distribution], prepared: Prepared | None = None
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Final state of the undispersed flight and the covariance of the final state about it.

    The final state's Jacobian with respect to every dispersed quantity, through the same gains,
    holds and integrator as the flights, sandwiches their covariance. Sensor noise is not included.
    `prepared`: `shared(mission, dispersions)` if at hand.

    **Error:** first order in the dispersions; a sweep beside it shows what is left.
    """
    shapes = jax.eval_shape(lambda: draw(mission, dispersions, jax.random.key(0)))
    zeros = {path: jnp.zeros(s.shape, s.dtype) for path, s in shapes.items()}

    def end(draws: dict[str, Array]) -> tuple[Array, Array]:
        flight = simulate(apply(mission, draws), jax.random.key(0), "ends", prepared)
        return flight.final_state, flight.final_state

    jacobians, final = jax.jacfwd(end, has_aux=True)(zeros)
    n = final.shape[0]
    total = jnp.zeros((n, n), final.dtype)
    for paths, covariance in spread(mission, dispersions):
        flat = jnp.concatenate([jacobians[path].reshape(n, -1) for path in paths], axis=1)
        total = total + flat @ covariance.astype(final.dtype) @ flat.T
    return final, total
