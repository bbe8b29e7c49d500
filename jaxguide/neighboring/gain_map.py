"""Gains at any time and histories between samples, from a sweep or from remaining horizons."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.linalg import gauss_solve
from jaxguide.neighboring.collocated import Horizons
from jaxguide.neighboring.costate_gains import gains_at
from jaxguide.neighboring.propagation import propagate
from jaxguide.neighboring.segmented import canonical_at
from jaxguide.neighboring.sweep import Sweep
from jaxguide.spectral import interpolate
from jaxguide.trajectory import Extremal, Point

# Share of the span of times by which a time may differ from a sample and count as it: some 1e4
# roundings, chosen.
_SAME_TIME = 1e-12


class GainMap(eqx.Module):
    """Abstract: the gains of a `GainSchedule` between its `times`, and its histories."""

    @abc.abstractmethod
    def gain(
        self, extremal: Extremal, times: Float[Array, " time"], t: Float[Array, ""], point: Point
    ) -> Float[Array, "m n"]:
        """K(t): du(t) per dx(t), `t` within `[times[0], times[-1]]`; `point`: `extremal(t)`."""

    @abc.abstractmethod
    def history(
        self,
        extremal: Extremal,
        times: Float[Array, " time"],
        t_k: Float[Array, ""],
        t: Float[Array, ""],
    ) -> Float[Array, "m n"]:
        """du(t) per dx(t_k), t >= t_k: 2002 paper, eq. (49)."""


class SweptGains(GainMap):
    """From the backward sweep: exact at all times."""

    sweep: Sweep

    def gain(
        self, extremal: Extremal, times: Float[Array, " time"], t: Float[Array, ""], point: Point
    ) -> Float[Array, "m n"]:
        c, _ = canonical_at(extremal.problem, t, point, ())
        return gains_at(self.sweep, c, t, False).K[:, : extremal.problem.n]

    def history(
        self,
        extremal: Extremal,
        times: Float[Array, " time"],
        t_k: Float[Array, ""],
        t: Float[Array, ""],
    ) -> Float[Array, "m n"]:
        c, _ = canonical_at(extremal.problem, t, extremal(t), ())
        return c.U @ propagate(self.sweep, t_k, t)


class HorizonGains(GainMap):
    """From the solution on the remaining horizon of each of the schedule's times: 2002 paper,
    eqs (46)-(49). Between two times, that of the earlier one is used."""

    horizons: Horizons

    def gain(
        self, extremal: Extremal, times: Float[Array, " time"], t: Float[Array, ""], point: Point
    ) -> Float[Array, "m n"]:
        # du(t) = C(t) dx(t_k) and dx(t) = X(t) dx(t_k) on the horizon begun at t_k <= t.
        X, C = self._maps(extremal, times, t, t)
        return gauss_solve(X.T, C.T).T

    def history(
        self,
        extremal: Extremal,
        times: Float[Array, " time"],
        t_k: Float[Array, ""],
        t: Float[Array, ""],
    ) -> Float[Array, "m n"]:
        return self._maps(extremal, times, t_k, t)[1]

    def _maps(
        self, extremal: Extremal, times: Array, t_k: Array, t: Array
    ) -> tuple[Float[Array, "n n"], Float[Array, "m n"]]:
        """dx(t) and du(t) per deviation at the last of `times` up to `t_k`."""
        slack = _SAME_TIME * (times[-1] - times[0] + jnp.abs(t_k))
        after = jnp.searchsorted(times, t_k + slack, side="right", method="compare_all")
        k = jnp.clip(after - 1, 0, times.shape[0] - 1)
        a, b = times[k], extremal.t[-1]
        tau = 2 * (t - a) / (b - a) - 1
        nodes, states, controls = self.horizons
        return interpolate(nodes, states[k], tau), interpolate(nodes, controls[k], tau)
