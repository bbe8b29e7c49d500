"""Gains between the stations at which they were computed, and after the last one (thesis, section
4.3)."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.neighboring.suboptimal import SuboptimalSchedule
from jaxguide.spectral import interval


class StationGains(NamedTuple):
    """Gains at one place tau of the horizon, per deviation of the state there.

    `here` (m, n): change of the control at tau. `ahead` (m, n): its change `spacing` further on
    (a fraction of the horizon). `time` (n,): change of the time to go, up to a factor.
    """

    here: Float[Array, "m n"]
    ahead: Float[Array, "m n"]
    time: Float[Array, " n"]
    spacing: Float[Array, ""]


class Interpolation(eqx.Module):
    """Abstract: gains at any place of the horizon, from those at the stations."""

    @abc.abstractmethod
    def __call__(self, schedule: SuboptimalSchedule, tau: Any) -> StationGains:
        """The gains at `tau` (), a fraction of the horizon, which may lie after the last
        station."""


class LinearGains(Interpolation):
    """Linear between stations; after the last station the line through the last two goes on.

    **Source:** thesis, eqs (4.39)-(4.42).
    """

    def __call__(self, schedule: SuboptimalSchedule, tau: Any) -> StationGains:
        blend = _blend(schedule.stations, tau)
        return StationGains(
            blend(schedule.here),
            blend(schedule.ahead),
            blend(schedule.K_time),
            blend(schedule.spacing),
        )


class TimeToGoGains(Interpolation):
    r"""Gains grow without bound as the time to go, $1 - \tau$, goes to zero. The product
    $K (1 - \tau)^p$ does not: it is interpolated, and held after the last station.

    **Arguments:** `powers` (n,): p of each state: 1 for a state that is itself constrained at the
    end and driven by the control through one integration (a velocity), 2 through two (a position),
    0 for a state that does not matter.
    """

    powers: Any

    def __call__(self, schedule: SuboptimalSchedule, tau: Any) -> StationGains:
        powers = jnp.asarray(self.powers, schedule.stations.dtype)
        stations, last = schedule.stations, schedule.stations[-1]
        left = lambda tau: (1 - tau) ** powers
        scale = jax.vmap(left)(stations)[:, None, :]
        blend = _blend(stations, jnp.minimum(tau, last))
        # A time to go below a thousandth of the last station's counts as that much, so that no gain
        # is infinite. Chosen, not tuned: a flight is then as good as over.
        least = (1 - last) * 1e-3
        now = left(jnp.maximum(1 - tau, least) * -1 + 1)[None, :]
        time = (1 - stations)[:, None] * schedule.K_time
        remaining = jnp.where(tau < last, blend(schedule.spacing), jnp.maximum(1 - tau, least))
        return StationGains(
            blend(schedule.here * scale) / now,
            blend(schedule.ahead * scale) / now,
            _blend(stations, tau)(time),
            remaining,
        )


def _blend(stations: Float[Array, " g"], tau: Any) -> Any:
    """Linear interpolation to `tau`: between the stations about it, or on the line through the last
    two after them. Returns a function of the values at the stations."""
    if stations.shape[0] == 1:
        return lambda values: values[0]
    i = interval(stations, tau)
    share = (tau - stations[i]) / (stations[i + 1] - stations[i])
    return lambda values: values[i] + share * (values[i + 1] - values[i])
