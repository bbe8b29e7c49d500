"""Neighbouring suboptimal guidance by the clock or by the time to go (thesis, chapter 4)."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.laws.gain_interpolation import Interpolation, LinearGains, StationGains
from jaxguide.laws.law import Command, Law
from jaxguide.neighboring.suboptimal import SuboptimalSchedule
from jaxguide.problem import is_free
from jaxguide.types import RESULTS, is_traced

# Newton's steps in the search for the reference time. Each doubles the digits of a guess that is
# good to a few percent: five are enough for rounding.
_ITERATIONS = 5
# A search has converged if its last step is below this fraction of the horizon: Newton's next one
# would be of order its square, far below rounding.
_FOUND = 1e-9


class Plan(eqx.Module):
    """The control from a sample on: u = u*(t - offset) + du + slope (t - since).

    `offset` (): time by which the nominal's clock runs behind the flight's; `since` (): flight time
    at which the correction is `du` (m,); `slope` (m,): its rate.
    """

    offset: Float[Array, ""]
    since: Float[Array, ""]
    du: Float[Array, " m"]
    slope: Float[Array, " m"]


class SuboptimalCommand(Command):
    """Nominal and correction, each piecewise linear in time.

    `left` (): time to go, of a law that decides the end.
    """

    schedule: SuboptimalSchedule
    plan: Plan
    result: RESULTS
    saturated: Bool[Array, ""]
    left: Float[Array, ""] | None = None

    def nominal(self, t: Any) -> Float[Array, " m"]:
        schedule = self.schedule
        tau = (t - self.plan.offset - schedule.initial_time) / schedule.duration
        return schedule.control(tau).astype(self.plan.du.dtype)

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self.plan.du + self.plan.slope * (t - self.plan.since)

    @property
    def time_to_go(self) -> Float[Array, ""] | None:
        return self.left


def _planned(
    schedule: SuboptimalSchedule, gains: StationGains, offset: Array, since: Array, dx: Array
) -> Plan:
    """A correction that goes in a straight line from the change here to that at the next node
    (thesis, eqs (4.39)-(4.43))."""
    du, ahead = gains.here.astype(dx.dtype) @ dx, gains.ahead.astype(dx.dtype) @ dx
    slope = (ahead - du) / (gains.spacing * schedule.duration).astype(dx.dtype)
    return Plan(offset, since, du, slope)


def _choose(first: Array, a: Plan, b: Plan) -> Plan:
    """`a` where `first`, else `b`."""
    return jax.tree_util.tree_map(lambda a, b: jnp.where(first, a, b), a, b)


class NeighboringSuboptimal(Law):
    """u = u*(t) + du(t), with du from the deviation of the state from the nominal at the same time.

    For a nominal whose independent variable has a given end: a fixed final time, or a state in
    place of time (`jg.StateAsTime`), as in Nowack's law, which holds the correction
    (`jg.HoldDeviation`). Outside the nominal's horizon the result is `outside_horizon`.

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
    """u = u*(t0) + du, where t0, the reference time, is the time on the nominal at which the time
    to go equals that of the measured state: there its change, K_time dx, vanishes. For a free final
    time, which the law decides: a flight lasts as long as its time to go.

    **Arguments:**

    - `schedule`, `interpolation`: as in `NeighboringSuboptimal`.
    - `window`: half the width of the interval in which the reference time is sought, as a fraction
      of the horizon, about the time to which the last reference time leads. If there is none in it,
      the command goes on as it was, with the result `no_reference_time`.
    - `quiet`: length, in the plant's unit of time, of the last part of the flight, in which only
      the time to go is updated and the correction goes on as it was: its gains grow without bound
      there, and little is left to correct. With 0 there is no such part, not even past the end.

    **Error:** the reference time to rounding; its derivative is that of the root.

    **Raises:** `ValueError` for a nominal whose final time is given, a window that is not positive,
    or a negative `quiet`.

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

    def __call__(
        self, t_k: Any, x: Float[Array, " n"], memory: Plan
    ) -> tuple[SuboptimalCommand, Plan]:
        schedule, t_k = self.schedule, jnp.asarray(t_k, x.dtype)
        begin, duration = (v.astype(x.dtype) for v in (schedule.initial_time, schedule.duration))
        guess = (t_k - memory.offset - begin) / duration
        tau, found = self._reference(x, guess)
        reference = begin + tau * duration
        dx = x - schedule.state(tau).astype(x.dtype)
        gains = self.interpolation(schedule, tau)
        fresh = _planned(schedule, gains, t_k - reference, t_k, dx)
        left = begin + duration - reference  # if none was found, by the last reference time
        held = dataclasses.replace(memory, offset=fresh.offset)
        quiet = (left < self.quiet) & (self.quiet > 0)
        plan = _choose(found & ~quiet, fresh, _choose(found, held, memory))
        result = RESULTS.where(found, RESULTS.successful, RESULTS.no_reference_time)
        command = SuboptimalCommand(
            schedule=schedule, plan=plan, result=result, saturated=jnp.array(False), left=left
        )
        return command, plan

    def latest_end(self, initial_time: Any) -> Float[Array, ""]:
        # Half as long again as the nominal (chosen): a longer flight is no neighbour of it.
        return initial_time + 1.5 * self.schedule.duration

    def _reference(self, x: Array, guess: Array) -> tuple[Array, Bool[Array, ""]]:
        """The fraction of the horizon at which the time to go does not change, and whether it was
        found (`guess` if not)."""
        frozen, at, middle = jax.lax.stop_gradient((self, x, guess))
        value = lambda tau: _change(frozen, at, tau)
        both = lambda tau: jax.jvp(value, (tau,), (jnp.ones_like(tau),))
        # Its last polynomial gives the nominal a little past its end: a quarter interval (chosen).
        positions = frozen.schedule.positions
        past = 1 + (1 - positions[-2]).astype(x.dtype) / 4
        low = jnp.asarray(middle - self.window, x.dtype)
        high = jnp.minimum(middle + self.window, past).astype(x.dtype)
        # Compared with an earlier nominal state the vehicle is ahead: the change rises through zero
        # (page 28 of the thesis has the signs the other way round).
        below, above = jax.vmap(value)(jnp.stack([low, high]))
        bracketed = (below < 0) & (above > 0)

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
        # One more step of Newton gives the derivatives of the root.
        steep = jax.lax.stop_gradient(jnp.where(found, both(tau)[1], 1.0))
        return jnp.where(found, tau - _change(self, x, tau) / steep, guess), found


@eqx.filter_jit
def _change(law: TimeToGo, x: Array, tau: Array) -> Float[Array, ""]:
    """Change of the time to go if `x` is the state at `tau`. Jitted, so that its uses are traced,
    batched and differentiated once."""
    gains = law.interpolation(law.schedule, tau)
    return jnp.dot(gains.time.astype(x.dtype), x - law.schedule.state(tau).astype(x.dtype))
