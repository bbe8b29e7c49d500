"""What is measured of one flight of a mission: (mission as flown, flight) -> a number."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.bounds import overstep
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, sample_times


def endpoint_miss(mission: Mission, flight: Flight) -> Float[Array, ""]:
    """Euclidean norm of how far the plant's endpoint constraints are off at the end, in their own
    units. Weigh them by a measure of your own where the units differ."""
    plant = mission.plant
    at = (mission.initial_state, flight.final_state, mission.initial_time, flight.final_time)
    e = plant.endpoint_constraints(*at)
    squares = jnp.sum(overstep(e, plant.endpoint_bounds) ** 2)
    # The root's derivative at zero is taken as zero.
    return jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)


def cost(mission: Mission, flight: Flight) -> Float[Array, ""]:
    """Cost of the flight: the plant's endpoint cost, and its running cost by the trapezoidal rule
    on the samples (save="samples"; with "ends" only a Problem without one is measured rightly)."""
    plant = mission.plant
    at = (mission.initial_state, flight.final_state, mission.initial_time, flight.final_time)
    u = jnp.concatenate([flight.u, flight.u[-1:]])
    rate = [plant.running_cost(flight.t[k], flight.x[k], u[k]) for k in range(flight.t.shape[0])]
    values = jnp.stack([jnp.asarray(r, u.dtype) for r in rate])
    running = jnp.sum((values[1:] + values[:-1]) / 2 * jnp.diff(flight.t))
    return jnp.asarray(plant.endpoint_cost(*at), u.dtype) + running


def effort(mission: Mission, flight: Flight) -> Float[Array, ""]:
    """Integral of the squared deviation of the control from its nominal; exact where a hold keeps
    it over each sample. Needs save="samples"."""
    return jnp.sum(flight.commands**2 * jnp.diff(flight.t)[:, None])


def gain_evaluations(mission: Mission) -> int:
    """How often the law is asked in a whole flight, for which it stores as many gains: samples of
    some length. Host only, for missions that are no traces; while tuning, use the relaxed count.
    """
    times = np.asarray(sample_times(mission))
    return int(np.sum(np.diff(times) > 1e-12 * (times[-1] - times[0])))
