"""Interpolation of a law's gains between stations, each of which may be left out."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxguide.laws.gain_interpolation import Interpolation, StationGains
from jaxguide.neighboring.suboptimal import SuboptimalSchedule
from jaxguide.tuning.relaxation import thinned_weights


class ThinnedGains(Interpolation):
    """`jg.TimeToGoGains` in the mean over the stations that are kept.

    **Arguments:** `powers` (n,): as in `jg.TimeToGoGains`; `present` (g,): the probability
    with which each station is kept; the first and the last always are.
    """

    powers: Any
    present: Any

    def __call__(self, schedule: SuboptimalSchedule, tau: Any) -> StationGains:
        stations = schedule.stations
        powers = jnp.asarray(self.powers, stations.dtype)
        last = stations[-1]
        left = lambda tau: (1 - tau) ** powers
        scale = jax.vmap(left)(stations)[:, None, :]
        mean = lambda tau: thinned_weights(stations, self.present, tau)
        # As in `jg.TimeToGoGains`: the time to go below which gains no longer grow, so that they
        # stay finite at the end.
        least = (1 - last) * 1e-3
        now = left(1 - jnp.maximum(1 - tau, least))[None, :]
        w, on = mean(jnp.minimum(tau, last)), mean(tau)
        time = (1 - stations)[:, None] * schedule.K_time
        # The spacing to the node ahead is that of the schedule, not that of the stations kept.
        spacing = jnp.where(tau < last, w @ schedule.spacing, jnp.maximum(1 - tau, least))
        return StationGains(
            jnp.tensordot(w, schedule.here * scale, 1) / now,
            jnp.tensordot(w, schedule.ahead * scale, 1) / now,
            on @ time,
            spacing,
        )
