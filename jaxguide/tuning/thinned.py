"""Stored gain stations that may be left out, as a law's interpolation."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxguide.laws.gain_interpolation import Interpolation, StationGains
from jaxguide.neighboring.suboptimal import SuboptimalSchedule
from jaxguide.tuning.relaxation import thinned_weights


class ThinnedGains(Interpolation):
    """`jg.TimeToGoGains` with stations that are there only in part: the mean over which are.

    **Arguments:** `powers` (n,): as there; `present` (g,): probability of each station. The first
    and the last always are there.
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
        least = (1 - last) * 1e-3  # no gain is infinite
        now = left(1 - jnp.maximum(1 - tau, least))[None, :]
        w, on = mean(jnp.minimum(tau, last)), mean(tau)
        time = (1 - stations)[:, None] * schedule.K_time
        # The next node is `ahead` of the place itself, not of the stations that are there.
        spacing = jnp.where(tau < last, w @ schedule.spacing, jnp.maximum(1 - tau, least))
        return StationGains(
            jnp.tensordot(w, schedule.here * scale, 1) / now,
            jnp.tensordot(w, schedule.ahead * scale, 1) / now,
            on @ time,
            spacing,
        )
