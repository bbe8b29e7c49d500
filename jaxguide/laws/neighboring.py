"""Neighbouring optimal control: du = K dx, sampled (2002 paper, eq. (49) and section 4)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.laws.lanes import GridLaw, Lanes, SampleGrid, StagedCommand, lanes
from jaxguide.laws.law import Command, Law
from jaxguide.neighboring.gains import GainSchedule
from jaxguide.types import RESULTS, is_traced


class NeighboringOptimal(GridLaw):
    """u = u*(t) + du(t), with du from the deviation dx = x - x*(t_k) measured at the sample.

    The command carries the whole open-loop history du(t) of the 2002 paper, eq. (49), up to the
    final time; a hold decides how much of it is flown.

    **Arguments:**

    - `schedule`: the gains, from `jg.gain_schedule`.
    - `cap`: bound on |du|, for each control or one for all, in their units (inf: none). A command
      that it limits is `saturated`.
    - `scale`: a factor on every gain.

    **Error:** that of the schedule's gains. A command asked for outside the nominal's horizon has
    the result `outside_horizon`.

    **Raises:** `ValueError` for a cap that is not positive.
    """

    schedule: GainSchedule
    cap: Any = np.inf
    scale: Any = 1.0

    def __check_init__(self):
        if not is_traced(self.cap) and not np.all(np.asarray(self.cap) > 0):
            raise ValueError(
                f"NeighboringOptimal: cap is {self.cap}; give a positive bound on |du|."
            )

    def start(self, x0: Float[Array, " n"]) -> None:
        return None

    def __call__(
        self, t_k: Any, x: Float[Array, " n"], memory: None
    ) -> tuple["NeighboringCommand", None]:
        schedule = self.schedule
        t_k = jnp.asarray(t_k, schedule.times.dtype)
        dx = x - schedule.extremal(t_k).x.astype(x.dtype)
        inside = (t_k >= schedule.extremal.t[0]) & (t_k < schedule.extremal.t[-1])
        result = RESULTS.where(inside, RESULTS.successful, RESULTS.outside_horizon)
        _, saturated = _capped(self._gain(t_k, t_k).astype(x.dtype) @ dx, self.cap)
        return NeighboringCommand(
            law=self, t_k=t_k, dx=dx, result=result, saturated=saturated
        ), None

    def _gain(self, t_k: Any, t: Any) -> Float[Array, "m n"]:
        """du(t) per dx(t_k). Before the schedule's first time and after its last, the gain of that
        time is used."""
        known = self.schedule.known(t_k)
        return self.scale * self.schedule.history(known, jnp.where(known == t_k, t, known))

    def prepared(self, grid: SampleGrid, histories: bool) -> "PreparedNeighboring":
        extremal = self.schedule.extremal
        as_gains = lambda a: a.astype(extremal.t.dtype)
        grid_times, stages = as_gains(grid.times), as_gains(grid.stages)
        # The extremal at all times at once, which is compiled once.
        known, count = self.schedule.known(grid_times), grid_times.shape[0]
        points = extremal(jnp.concatenate([known, grid_times, stages.reshape(-1)]))
        first = jax.tree_util.tree_map(lambda a: a[:count], points)
        K = jax.vmap(self.schedule.at)(known, first)
        maps = None
        # One `vmap` over all stages: two, nested, take twice as long to trace.
        by_stage = lambda a: a.reshape(*stages.shape, *a.shape[1:])
        if histories:
            samples = jnp.repeat(grid_times, stages.shape[1])
            maps = by_stage(jax.vmap(self._gain)(samples, stages.reshape(-1)))
        stacked = PreparedNeighboring(
            points.x[count : 2 * count],
            self.scale * K,
            by_stage(points.u[2 * count :]),
            maps,
            jnp.broadcast_to(jnp.asarray(self.cap, K.dtype), (grid.times.shape[0],)),
            grid_times < extremal.t[-1],
        )
        # Gains are float64; the flight may not be.
        to_flight = lambda a: a.astype(grid.times.dtype) if eqx.is_inexact_array(a) else a
        return jax.tree_util.tree_map(to_flight, stacked)


class NeighboringCommand(Command):
    """The nominal control and the history du(t) = K(t; t_k) dx, limited to the law's cap."""

    law: NeighboringOptimal
    t_k: Float[Array, ""]
    dx: Float[Array, " n"]
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.law.schedule.extremal(t).u.astype(self.dx.dtype)

    def deviation(self, t: Any) -> Float[Array, " m"]:
        gain = self.law._gain(self.t_k, jnp.asarray(t, self.t_k.dtype)).astype(self.dx.dtype)
        return _capped(gain @ self.dx, self.law.cap)[0]


class PreparedNeighboring(Law):
    """`NeighboringOptimal` with its gains looked up: of all samples (a leading axis k on every
    leaf, as `prepared` gives it), or of one, which can be called.

    `maps`: du at each stage per dx at the sample; None where only the sample's own is flown.
    `inside`: whether the sample lies within the nominal's horizon.
    """

    x_nominal: Float[Array, "*k n"]
    K: Float[Array, "*k m n"]
    u_nominal: Float[Array, "*k stage m"]
    maps: Float[Array, "*k stage m n"] | None
    cap: Float[Array, "*k"]
    inside: Bool[Array, "*k"]

    def start(self, x0: Float[Array, " n"]) -> None:
        return None

    def __call__(
        self, t_k: Any, x: Float[Array, " n"], memory: None
    ) -> tuple["PreparedCommand", None]:
        dx = tuple(x[i] - self.x_nominal[i] for i in range(x.shape[0]))
        du = _product(self.K, dx)
        du, saturated = _capped(du, self.cap)
        result = RESULTS.where(self.inside, RESULTS.successful, RESULTS.outside_horizon)
        command = PreparedCommand(
            law=self, t_k=t_k, dx=jnp.stack(dx), at_sample=du, result=result, saturated=saturated
        )
        return command, None


class PreparedCommand(StagedCommand):
    """A NeighboringCommand that is known at its sample and at the stages alone.

    **Raises:** `ValueError` from `nominal` and `deviation` at any other time than the very `t_k`
    with which the law was called: its value there is not known.
    """

    law: PreparedNeighboring
    t_k: Any
    dx: Float[Array, " n"]
    at_sample: Float[Array, " m"]
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        self._require_sample(t)
        return self.law.u_nominal[0]

    def deviation(self, t: Any) -> Float[Array, " m"]:
        self._require_sample(t)
        return self.at_sample

    def _require_sample(self, t: Any) -> None:
        if t is not self.t_k:  # one object: under a trace, times cannot be compared
            raise ValueError(
                "A command prepared for a fast flight was asked for its control at another time "
                "than its sample. Derive what asks (a hold, say) from jg.Hold itself: it is then "
                "given the law's own command."
            )

    def nominal_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        return tuple(lanes(self.law.u_nominal[j]) for j in range(times.shape[0]))

    def deviation_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        maps = self.law.maps
        assert maps is not None
        at = lambda j: _capped(_product(maps[j], lanes(self.dx)), self.law.cap)[0]
        return tuple(lanes(at(j)) for j in range(times.shape[0]))


def _product(K: Float[Array, "m n"], dx: Lanes) -> Float[Array, " m"]:
    """K dx by multiplications and additions: under `vmap` a dot product of n entries is slower."""
    rows = [sum(K[j, i] * dx[i] for i in range(len(dx))) for j in range(K.shape[0])]
    return jnp.stack(rows)


def _capped(du: Array, cap: Any) -> tuple[Array, Bool[Array, ""]]:
    """`du` limited to `cap` in each control, and whether that changed it."""
    cap = jnp.asarray(cap, du.dtype)
    limited = jnp.clip(du, -cap, cap)
    return limited, jnp.any(jnp.abs(du) > cap)
