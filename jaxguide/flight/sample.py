"""One sample of the closed loop: sense, estimate, command, hold, actuate, fly."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.flight.disturbances import Disturbance
from jaxguide.flight.integrators import Rate, StagedIntegrator, stacked
from jaxguide.flight.mission import Mission
from jaxguide.flight.sensors import Sensor
from jaxguide.laws.lanes import Lanes, StagedCommand, lanes, staged
from jaxguide.laws.law import Command, Law
from jaxguide.types import RESULTS

# Numbers of keys that no sample has: of the call before the first, and of the disturbance's own
# stream. The sensor's key at sample k is the flight's folded with k.
_BEFORE = 2**32 - 1
_DISTURBANCE = 2**32 - 2


class Memories(NamedTuple):
    """The memory of each part of the loop; None of a part that is absent or has none."""

    law: Any
    hold: Any
    last: Any
    sensor: Any
    estimator: Any
    disturbance: Any
    actuator: Any


class Loop(eqx.Module):
    """The state of a flight at a sample. `saturated` (): samples flown at a limit; `result`: the
    first reason why the flight is not to be trusted."""

    x: Lanes
    memories: Memories
    saturated: Float[Array, ""]
    result: RESULTS


class Span(NamedTuple):
    """Sample number `k`, from `t` to `t_next`; `stages`: the integrator's times within it, if the
    flight is fast; `is_last`: whether the flight is meant to end with it."""

    k: Array
    t: Array
    t_next: Array
    stages: Array | None
    is_last: Bool[Array, ""]


def begin(mission: Mission, key: Any) -> Loop:
    """The loop before the first sample.

    **Raises:** `ValueError` for a random part without a key.
    """
    for role in ("sensor", "disturbance"):
        if key is None and _is_random(getattr(mission, role)):
            raise ValueError(
                f"simulate: the mission has a {role}, which needs a PRNG key; pass key=."
            )
    x0 = mission.initial_state
    sensor, disturbance = _keys(mission, key, _BEFORE)
    started = lambda part, *given: None if part is None else part.start(*given)
    memories = Memories(
        law=mission.law.start(x0),
        hold=mission.hold.start(),
        last=started(mission.last),
        sensor=started(mission.sensor, sensor, x0),
        estimator=started(mission.estimator, x0),
        disturbance=started(mission.disturbance, disturbance, x0),
        actuator=started(mission.actuator, mission.plant),
    )
    success = RESULTS.where(jnp.array(True), RESULTS.successful, RESULTS.successful)
    return Loop(lanes(x0), memories, jnp.zeros((), x0.dtype), success)


def _is_random(part: Sensor | Disturbance | None) -> bool:
    return part is not None and part.random


def _keys(mission: Mission, key: Any, k: Any) -> tuple[Any, Any]:
    """Keys of the sensor and of the disturbance at sample k; None for one that is not random."""
    sensor = disturbance = None
    if _is_random(mission.sensor):
        sensor = jax.random.fold_in(key, k)
    if _is_random(mission.disturbance):
        disturbance = jax.random.fold_in(jax.random.fold_in(key, _DISTURBANCE), k)
    return sensor, disturbance


def asked(
    mission: Mission, law: Law, key: Any, loop: Loop, k: Array, t: Array
) -> tuple[Command, Loop]:
    """The law's command at sample `k`, from the state as it is sensed and estimated."""
    x, memories = jnp.stack(loop.x), loop.memories
    seen = x
    if mission.sensor is not None:
        sensor_key, _ = _keys(mission, key, k)
        seen, memory = mission.sensor(sensor_key, t, x, memories.sensor)
        memories = memories._replace(sensor=memory)
    if mission.estimator is not None:
        estimate, memory = mission.estimator.update(memories.estimator, t, seen)
        seen, memories = estimate.state, memories._replace(estimator=memory)
    command, memory = law(t, seen, memories.law)
    return command, _with_memories(loop, memories._replace(law=memory))


def _with_memories(loop: Loop, memories: Memories) -> Loop:
    return Loop(loop.x, memories, loop.saturated, loop.result)


def _as_flown(
    mission: Mission, command: Command, span: Span, memories: Memories
) -> tuple[Command, Memories]:
    """The command after hold and actuator."""
    flown, memory = mission.hold(command, span.t, memories.hold)
    memories = memories._replace(hold=memory)
    if mission.last is not None:
        other, memory = mission.last(command, span.t, memories.last)
        memories = memories._replace(last=memory)
        flown = EitherCommand(
            first=other,
            second=flown,
            is_first=span.is_last,
            result=RESULTS.where(span.is_last, other.result, flown.result),
            saturated=jnp.where(span.is_last, other.saturated, flown.saturated),
        )
    if mission.actuator is not None:
        flown, memory = mission.actuator(flown, span.t, memories.actuator)
        memories = memories._replace(actuator=memory)
    return flown, memories


class EitherCommand(StagedCommand):
    """The command `first` where `is_first`, else `second`."""

    first: Command
    second: Command
    is_first: Bool[Array, ""]
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return jnp.where(self.is_first, self.first.nominal(t), self.second.nominal(t))

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return jnp.where(self.is_first, self.first.deviation(t), self.second.deviation(t))

    def nominal_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        first, second = staged(self.first), staged(self.second)
        return self._chosen(first.nominal_on(times), second.nominal_on(times))

    def deviation_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        first, second = staged(self.first), staged(self.second)
        full = lambda d: d * (times.shape[0] if len(d) == 1 else 1)
        return self._chosen(full(first.deviation_on(times)), full(second.deviation_on(times)))

    def _chosen(self, a: tuple[Lanes, ...], b: tuple[Lanes, ...]) -> tuple[Lanes, ...]:
        return jax.tree_util.tree_map(lambda a, b: jnp.where(self.is_first, a, b), a, b)


def _rate(mission: Mission, key: Any, memory: Any) -> Rate:
    """dx/dt of the plant within a sample, with the disturbance of the sample's key and memory."""
    plant, disturbance = mission.plant, mission.disturbance

    def rate(t: Any, x: Array, u: Array) -> Array:
        dx = plant.dynamics(t, x, u)
        return dx if disturbance is None else dx + disturbance(key, t, x, memory)[0]

    return rate


def _across(mission: Mission, rate: Rate, flown: Command, span: Span, x: Lanes) -> Lanes:
    """The state at the end of the sample; NaN where the integrator failed."""
    t, t_next = span.t, span.t_next
    if span.stages is not None:
        assert isinstance(mission.integrator, StagedIntegrator)
        at_stages = staged(flown)
        nominal, deviation = at_stages.nominal_on(span.stages), at_stages.deviation_on(span.stages)
        integrator = mission.integrator
        return integrator.across_stages(stacked(rate), t, t_next - t, x, nominal, deviation)
    final, result = mission.integrator.across(rate, flown, t, t_next, jnp.stack(x))
    return lanes(jnp.where(result == RESULTS.successful, final, jnp.nan))


def flown_across(
    mission: Mission, key: Any, loop: Loop, command: Command, span: Span, save: bool
) -> tuple[Loop, Any]:
    """The loop at the next sample, and with `save` the state, control and deviation at this one."""
    t, t_next = span.t, span.t_next
    flown, memories = _as_flown(mission, command, span, loop.memories)
    _, own_key = _keys(mission, key, span.k)
    rate = _rate(mission, own_key, memories.disturbance)
    new = _across(mission, rate, flown, span, loop.x)
    if mission.disturbance is not None:
        x = jnp.stack(loop.x)
        _, memory = mission.disturbance(own_key, t, x, memories.disturbance)
        memories = memories._replace(disturbance=memory)
    if mission.estimator is not None:
        memory = mission.estimator.predict(memories.estimator, flown, t, t_next)
        memories = memories._replace(estimator=memory)
    out = (jnp.stack(loop.x), flown(t), flown.deviation(t)) if save else None
    return _judged(loop, new, flown, t_next != t, memories), out


def _judged(
    loop: Loop, new: Lanes, flown: Command, live: Bool[Array, ""], memories: Memories
) -> Loop:
    """The loop with the state `new`, held at the old one where that is not finite; `live`: whether
    the sample has a length, without which it counts for nothing."""
    finite = jnp.isfinite(sum(new[1:], new[0]))  # one test: NaN and inf survive a sum
    finite = finite & (loop.result != RESULTS.diverged)  # once diverged, held
    x = tuple(jnp.where(finite, b, a) for a, b in zip(loop.x, new, strict=True))
    result = RESULTS.where(loop.result == RESULTS.successful, flown.result, loop.result)
    result = RESULTS.where(finite, result, RESULTS.diverged)
    one, zero = jnp.ones((), x[0].dtype), jnp.zeros((), x[0].dtype)
    saturated = loop.saturated + jnp.where(live & flown.saturated, one, zero)
    return Loop(x, memories, saturated, RESULTS.where(live, result, loop.result))
