"""How far from its endpoint constraints a flight ended."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of, overstep
from jaxguide.flight.mission import Mission


def end_errors(mission: Mission, xf: Any, tf: Any) -> Float[Array, " q"]:
    """The endpoint constraints at the end of a flight, in units of `mission.miss` (of their own
    where none is given)."""
    e = mission.plant.endpoint_constraints(mission.initial_state, xf, mission.initial_time, tf)
    allowed = 1.0 if mission.miss is None else mission.miss
    return e / jnp.broadcast_to(jnp.asarray(allowed, e.dtype), e.shape)


def miss_distance(mission: Mission, xf: Any, tf: Any) -> Float[Array, ""]:
    """Length of the part of `end_errors` that lies outside the endpoint bounds; 0 without any."""
    e = end_errors(mission, xf, tf)
    allowed = 1.0 if mission.miss is None else mission.miss
    lo, hi = bounds_of(mission.plant.endpoint_bounds, e.shape[0], e.dtype)
    scale = jnp.broadcast_to(jnp.asarray(allowed, e.dtype), e.shape)
    off = overstep(e, (lo / scale, hi / scale))
    return jnp.sqrt(jnp.sum(off**2))
