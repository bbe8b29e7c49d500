"""Measures of one flight: (dispersed mission, flight) -> a number."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.bounds import overstep
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, sample_times

_EMPTY = 1e-12  # of the horizon: a shorter sample is one of no length, up to rounding


def endpoint_miss(mission: Mission, flight: Flight) -> Float[Array, ""]:
    """By how much the plant's endpoint constraints are missed, Euclidean norm, in their own units.

    Where the units differ, write a measure that weighs them.
    """
    plant = mission.plant
    at = (mission.initial_state, flight.final_state, mission.initial_time, flight.final_time)
    e = plant.endpoint_constraints(*at)
    squares = jnp.sum(overstep(e, plant.endpoint_bounds) ** 2)
    # The root's derivative at zero is taken as zero.
    return jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)


def cost(mission: Mission, flight: Flight) -> Float[Array, ""]:
    """Cost of the flight: the plant's endpoint cost plus the integral of its running cost.

    Needs save="samples", unless the plant has no running cost.

    **Error:** of the trapezoidal rule on the samples.
    """
    plant = mission.plant
    at = (mission.initial_state, flight.final_state, mission.initial_time, flight.final_time)
    u = jnp.concatenate([flight.u, flight.u[-1:]])
    rate = [plant.running_cost(flight.t[k], flight.x[k], u[k]) for k in range(flight.t.shape[0])]
    values = jnp.stack([jnp.asarray(r, u.dtype) for r in rate])
    running = jnp.sum((values[1:] + values[:-1]) / 2 * jnp.diff(flight.t))
    return jnp.asarray(plant.endpoint_cost(*at), u.dtype) + running


def effort(mission: Mission, flight: Flight) -> Float[Array, ""]:
    """Integral of the squared deviation of the control from its nominal. Needs save="samples".

    **Error:** exact if the hold keeps the deviation over each sample.
    """
    return jnp.sum(flight.commands**2 * jnp.diff(flight.t)[:, None])


def gain_evaluations(mission: Mission) -> int:
    """Number of samples of positive length in a whole flight: at each the law evaluates one gain.

    Host only, for a mission without traced values; in an objective use the relaxed count.
    """
    times = np.asarray(sample_times(mission))
    return int(np.sum(np.diff(times) > _EMPTY * (times[-1] - times[0])))
