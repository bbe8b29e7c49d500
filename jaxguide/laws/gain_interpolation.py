"""How gains are found between the stations that were computed, and after the last."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.neighboring.suboptimal import SuboptimalSchedule


class Gains(NamedTuple):
    """At one place of the horizon: change of the control there and `spacing` further on, and a
    multiple of the change of the time to go."""

    here: Float[Array, "m n"]
    ahead: Float[Array, "m n"]
    time: Float[Array, " n"]
    spacing: Float[Array, ""]


class Interpolation(eqx.Module):
    """How gains are found between their stations and after the last: see the two kinds."""

    @abc.abstractmethod
    def __call__(self, schedule: SuboptimalSchedule, tau: Any) -> Gains:
        """At the scalar `tau`."""


class LinearGains(Interpolation):
    """Linear between stations; after the last but one the line goes on: eqs (4.39)-(4.42)."""

    def __call__(self, schedule: SuboptimalSchedule, tau: Any) -> Gains:
        blend = _blend(schedule.stations, tau)
        return Gains(
            blend(schedule.here),
            blend(schedule.ahead),
            blend(schedule.K_time),
            blend(schedule.spacing),
        )


class TimeToGoGains(Interpolation):
    r"""Gains grow without bound as the time to go, $1 - \tau$, goes to zero; what is interpolated
    is $K (1 - \tau)^p$, which does not, and after the last station it is held.

    **Arguments:** `powers` (n,): p of each state: how often it is integrated to become what is
    constrained, plus one (2 for a position, 1 for a velocity, 0 for what does not matter).
    """

    powers: Any

    def __call__(self, schedule: SuboptimalSchedule, tau: Any) -> Gains:
        powers = jnp.asarray(self.powers, schedule.stations.dtype)
        stations, last = schedule.stations, schedule.stations[-1]
        left = lambda tau: (1 - tau) ** powers
        scale = jax.vmap(left)(stations)[:, None, :]
        blend = _blend(stations, jnp.minimum(tau, last))
        least = (1 - last) * 1e-3  # no gain is infinite
        now = left(jnp.maximum(1 - tau, least) * -1 + 1)[None, :]
        time = (1 - stations)[:, None] * schedule.K_time
        remaining = jnp.where(tau < last, blend(schedule.spacing), jnp.maximum(1 - tau, least))
        return Gains(
            blend(schedule.here * scale) / now,
            blend(schedule.ahead * scale) / now,
            _blend(stations, tau)(time),
            remaining,
        )


def _blend(stations: Float[Array, " g"], tau: Any) -> Any:
    """Linear in tau between the two nearest stations, or beyond the last two."""
    if stations.shape[0] == 1:
        return lambda values: values[0]
    after = jnp.searchsorted(stations, tau, side="right", method="compare_all")
    i = jnp.clip(after - 1, 0, stations.shape[0] - 2)
    share = (tau - stations[i]) / (stations[i + 1] - stations[i])
    return lambda values: values[i] + share * (values[i + 1] - values[i])
