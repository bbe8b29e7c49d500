"""Neighbouring suboptimal guidance by the clock or by the time to go (thesis, chapter 4)."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.laws.gain_interpolation import Gains, Interpolation, LinearGains
from jaxguide.laws.law import Command, Law
from jaxguide.neighboring.suboptimal import SuboptimalSchedule
from jaxguide.problem import is_free
from jaxguide.types import RESULTS, is_traced

_ITERATIONS = 5  # of the search; Newton doubles the digits of a guess good to a few percent
_FOUND = 1e-9  # of the horizon: the last step of a search that converged


class Plan(eqx.Module):
    """What a law has in mind: the nominal's clock runs `offset` behind the flight's, and the
    correction is `du` at the flight's time `since`, changing at `slope`."""

    offset: Float[Array, ""]
    since: Float[Array, ""]
    du: Float[Array, " m"]
    slope: Float[Array, " m"]


class SuboptimalCommand(Command):
    """Nominal and correction, each piecewise linear in time."""

    schedule: SuboptimalSchedule
    plan: Plan
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        schedule = self.schedule
        tau = (t - self.plan.offset - schedule.initial_time) / schedule.duration
        return schedule.control(tau).astype(self.plan.du.dtype)

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self.plan.du + self.plan.slope * (t - self.plan.since)


class TimedCommand(SuboptimalCommand):
    """Also knows how long the flight has to go."""

    left: Float[Array, ""]

    @property
    def time_to_go(self) -> Float[Array, ""]:
        return self.left


def _planned(
    schedule: SuboptimalSchedule, gains: Gains, offset: Array, since: Array, dx: Array
) -> Plan:
    """Eqs (4.39)-(4.43): from the change here to that at the next node, in a straight line."""
    du, ahead = gains.here.astype(dx.dtype) @ dx, gains.ahead.astype(dx.dtype) @ dx
    slope = (ahead - du) / (gains.spacing * schedule.duration).astype(dx.dtype)
    return Plan(offset, since, du, slope)


def _choose(first: Array, a: Plan, b: Plan) -> Plan:
    return jax.tree_util.tree_map(lambda a, b: jnp.where(first, a, b), a, b)


class NeighboringSuboptimal(Law):
    """u = u*(t) + du(t), du from the deviation at the sample, with the clock as reference.

    For a nominal whose independent variable ends where it should: a fixed final time, or a state
    (`jg.StateAsTime`), as in Nowack's law, which holds the correction (`jg.HoldDeviation`).

    **Arguments:** `schedule`: from `jg.suboptimal_gains`; `interpolation`: `LinearGains()` or
    `TimeToGoGains(powers)`.

    **Source:** thesis, section 4.3.
    """

    schedule: SuboptimalSchedule
    interpolation: Interpolation = LinearGains()

    def start(self, x0: Float[Array, " n"]) -> None:
        return None

    def __call__(
        self, t_k: Any, x: Float[Array, " n"], memory: None
    ) -> tuple[SuboptimalCommand, None]:
        schedule, t_k = self.schedule, jnp.asarray(t_k, x.dtype)
        tau = (t_k - schedule.initial_time) / schedule.duration
        dx = x - schedule.state(tau).astype(x.dtype)
        gains = self.interpolation(schedule, tau)
        plan = _planned(schedule, gains, jnp.zeros_like(t_k), t_k, dx)
        inside = (tau >= 0) & (tau < 1)
        result = RESULTS.where(inside, RESULTS.successful, RESULTS.outside_horizon)
        command = SuboptimalCommand(
            schedule=schedule, plan=plan, result=result, saturated=jnp.array(False)
        )
        return command, None


class TimeToGo(Law):
    """u = u*(t0) + du, where t0 is the time on the nominal at which the time to go is that of the
    state measured: there its change, K_time dx, vanishes. For a free final time, which the law
    then decides: a flight lasts as long as its time to go.

    **Arguments:**

    - `schedule`, `interpolation`: as in `NeighboringSuboptimal`.
    - `window`: how far from where the last one leads the reference time is looked for, in
      fractions of the horizon. If none is found there the plan goes on, and the result says so.
    - `quiet`: in the last so many units of time the correction is not updated, only the time to go:
      its gains grow without bound, and what they would correct is no longer worth it. With 0 there
      are none, not even past the end, where the search may lead.

    **Error:** the reference time to rounding; it is differentiated as the root it is.

    **Source:** thesis, eqs (4.36)-(4.45).
    """

    decides_end: ClassVar[bool] = True

    schedule: SuboptimalSchedule
    interpolation: Interpolation = LinearGains()
    window: Any = 0.1
    quiet: Any = 0.0

    def __check_init__(self):
        problem = self.schedule.extremal.problem
        if not is_free(problem.final_time):
            raise ValueError(
                f"TimeToGo: the final time of {type(problem).__name__} is given, so that there is "
                "no time to go to look for; use NeighboringSuboptimal, or make it a jg.Free."
            )
        if not is_traced(self.window) and not np.all(np.asarray(self.window) > 0):
            raise ValueError(f"TimeToGo: window is {self.window}; give a positive fraction.")
        if not is_traced(self.quiet) and not np.all(np.asarray(self.quiet) >= 0):
            raise ValueError(f"TimeToGo: quiet is {self.quiet}; give a time >= 0.")

    def start(self, x0: Float[Array, " n"]) -> Plan:
        zero = jnp.zeros((), x0.dtype)
        none = jnp.zeros(self.schedule.controls.shape[1], x0.dtype)
        return Plan(zero, self.schedule.initial_time.astype(x0.dtype), none, none)

    def __call__(self, t_k: Any, x: Float[Array, " n"], memory: Plan) -> tuple[TimedCommand, Plan]:
        schedule, t_k = self.schedule, jnp.asarray(t_k, x.dtype)
        begin, duration = (v.astype(x.dtype) for v in (schedule.initial_time, schedule.duration))
        guess = (t_k - memory.offset - begin) / duration
        tau, found = self._reference(x, guess)
        reference = begin + tau * duration
        dx = x - schedule.state(tau).astype(x.dtype)
        gains = self.interpolation(schedule, tau)
        fresh = _planned(schedule, gains, t_k - reference, t_k, dx)
        left = begin + duration - reference  # after a search in vain, as the last one had it
        held = dataclasses.replace(memory, offset=fresh.offset)
        quiet = (left < self.quiet) & (self.quiet > 0)
        plan = _choose(found & ~quiet, fresh, _choose(found, held, memory))
        result = RESULTS.where(found, RESULTS.successful, RESULTS.no_reference_time)
        command = TimedCommand(
            schedule=schedule, plan=plan, result=result, saturated=jnp.array(False), left=left
        )
        return command, plan

    def _reference(self, x: Array, guess: Array) -> tuple[Array, Bool[Array, ""]]:
        """Where on the nominal the time to go does not change, and whether it was found."""

        def change(tau: Array, law: "TimeToGo", x: Array) -> Array:
            gains = law.interpolation(law.schedule, tau)
            return jnp.dot(gains.time.astype(x.dtype), x - law.schedule.state(tau).astype(x.dtype))

        frozen, at, middle = jax.lax.stop_gradient((self, x, guess))
        value = lambda tau: change(tau, frozen, at)
        both = lambda tau: jax.jvp(value, (tau,), (jnp.ones_like(tau),))
        # The nominal is known a little past its end, by its last polynomial.
        positions = frozen.schedule.positions
        past = 1 + (1 - positions[-2]).astype(x.dtype) / 4
        low = jnp.asarray(middle - self.window, x.dtype)
        high = jnp.minimum(middle + self.window, past).astype(x.dtype)
        # Beside an earlier nominal state the vehicle is ahead: the change rises through zero (page
        # 28 of the thesis has it the other way round).
        bracketed = (value(low) < 0) & (value(high) > 0)

        def newton(carry: tuple, _: None) -> tuple[tuple, None]:
            tau, low, high, _ = carry
            off, slope = both(tau)
            low, high = jnp.where(off < 0, tau, low), jnp.where(off < 0, high, tau)
            new = tau - off / slope
            new = jnp.where((new >= low) & (new <= high), new, (low + high) / 2)
            return (new, low, high, jnp.abs(new - tau)), None

        begin = (jnp.clip(middle, low, high), low, high, jnp.full_like(low, jnp.inf))
        (tau, _, _, step), _ = jax.lax.scan(newton, begin, None, length=_ITERATIONS)
        settled = step <= jnp.maximum(_FOUND, 8 * jnp.finfo(x.dtype).eps)
        found = bracketed & settled
        tau = jax.lax.stop_gradient(jnp.where(found, tau, middle))
        # One step of Newton more, for its derivatives: those of the root.
        steep = jax.lax.stop_gradient(jnp.where(found, both(tau)[1], 1.0))
        return jnp.where(found, tau - change(tau, self, x) / steep, guess), found
