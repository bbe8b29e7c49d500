"""`jg.simulate`: one closed-loop flight, pure, differentiable, and fast under `vmap`."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.bounds import overstep
from jaxguide.flight.actuators import StagedActuator
from jaxguide.flight.estimators import PlainEstimator
from jaxguide.flight.integrators import StagedIntegrator
from jaxguide.flight.mission import Mission
from jaxguide.flight.sample import Loop, Span, asked, begin, flown_across
from jaxguide.host.compilation import kept_quickly
from jaxguide.laws.lanes import GridLaw, SampleGrid, StagedHold, vouches
from jaxguide.laws.law import Law
from jaxguide.types import RESULTS, is_traced

# The time to go, as a fraction of the sample interval, below which a flight is over (the thesis
# takes 1e-6 s, with samples of 4 s).
_OVER = 2.5e-7


class Flight(eqx.Module):
    """One flight. With `save="ends"` the histories hold the first and last sample only.

    `t` (K+1,), `x` (K+1, n) at sample times and the end (repeated where the law ended early); `u`
    (K, m) and `commands` (K, m), the control and its deviation as commanded at each sample;
    `saturated` (): samples at the cap.
    """

    t: Float[Array, " instant"]
    x: Float[Array, "instant n"]
    u: Float[Array, "sample m"]
    commands: Float[Array, "sample m"]
    final_state: Float[Array, " n"]
    final_time: Float[Array, ""]
    saturated: Float[Array, ""]
    result: RESULTS


class Prepared(NamedTuple):
    """The part of a mission that depends on time alone, shared by a batch of flights: sample times
    and, if it can be flown fast, the stage times and the law looked up at them (else None)."""

    times: Float[Array, " instant"]
    grid: SampleGrid | None
    laws: Law | None


def prepare(mission: Mission) -> Prepared:
    """The part of `mission` that depends on time alone, computed once for a batch."""
    times = sample_times(mission)
    holds = [hold for hold in (mission.hold, mission.last) if hold is not None]
    law, integrator = mission.law, mission.integrator
    fast = (
        not law.decides_end
        and all(vouches(hold, StagedHold) for hold in holds)
        and (mission.actuator is None or vouches(mission.actuator, StagedActuator))
        # Any other estimator may ask for the control that was flown at any time.
        and (mission.estimator is None or isinstance(mission.estimator, PlainEstimator))
    )
    if not (fast and vouches(law, GridLaw) and vouches(integrator, StagedIntegrator, "across")):
        return Prepared(times, None, None)
    stages = jnp.asarray(integrator.stages, times.dtype)
    grid = SampleGrid(times[:-1], times[:-1, None] + jnp.diff(times)[:, None] * stages[None, :])
    return Prepared(times, grid, law.prepared(grid, any(hold.uses_history for hold in holds)))


def simulate(
    mission: Mission, key: Any = None, save: str = "samples", prepared: Prepared | None = None
) -> Flight:
    """Flies `mission` once.

    **Arguments:** `key`: a PRNG key, needed by a sensor or a disturbance that is random; `save`:
    "samples" or "ends"; `prepared`: `prepare(mission)` if at hand (for batches that share times and
    law).

    **Returns:** a Flight. `.result` is `diverged` where the state left finite numbers (the state is
    then held at its last finite value), `outside_horizon` where the law was asked past its nominal,
    `end_not_reached` where a law that decides the end did not bring it about, `missed` where the
    endpoint constraints are overstepped by more than `mission.miss`.

    **Error:** that of the integrator: fixed steps, fourth order in sample_interval / steps;
    Adaptive, its tolerance. Differentiable in every leaf of the mission, the sample interval
    included (between the values at which the number of samples jumps), and the lengths of samples
    given one by one.

    **Raises:** `ValueError` for another `save`, and without a key that is needed.
    """
    if save not in ("samples", "ends"):
        raise ValueError(f"save is {save!r}; choose 'samples' or 'ends'.")
    arguments = mission, key, save == "samples", prepared
    return _flown(*arguments) if is_traced(arguments) else _program(*arguments)


def _flown(mission: Mission, key: Any, saved: bool, prepared: Prepared | None) -> Flight:
    start = begin(mission, key)
    if mission.law.decides_end:
        end, out, times = _until_arrival(mission, key, start, saved)
    else:
        known = prepare(mission) if prepared is None else prepared
        times = known.times
        end, out = _through_samples(mission, key, start, known, saved)
    x0, final = mission.initial_state, jnp.stack(end.x)
    result = end.result
    if mission.miss is not None:
        arrived = result == RESULTS.successful
        missed = arrived & ~_arrived(mission, x0, final, times[-1])
        result = RESULTS.where(missed, RESULTS.missed, result)
    if saved:
        xs, us, dus = out
        t, x = times, jnp.concatenate([xs, final[None]])
    else:
        t, x = jnp.stack([times[0], times[-1]]), jnp.stack([x0, final])
        us = dus = jnp.zeros((1, mission.plant.m), x0.dtype)
    return Flight(t, x, us, dus, final, times[-1], end.saturated, result)


# On the host: operation by operation it would be dozens of programs.
_program = kept_quickly(_flown)


def _scan(step: Any, start: Any, items: Any) -> tuple[Any, Any]:
    # Checkpointed: reverse mode keeps the state at each sample and flies the sample again.
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), start, items)  # pyright: ignore


def _through_samples(
    mission: Mission, key: Any, start: Loop, prepared: Prepared, save: bool
) -> tuple[Loop, Any]:
    """The loop after all samples, whose times are known ahead."""

    def sample(loop: Loop, item: tuple) -> tuple[Loop, Any]:
        k, t, t_next, stages, law = item
        law = mission.law if law is None else law
        command, loop = asked(mission, law, key, loop, k, t)
        span = Span(k, t, t_next, stages, k == mission.max_samples - 1)
        return flown_across(mission, key, loop, command, span, save)

    times, grid, laws = prepared
    count = jnp.arange(mission.max_samples)
    # The looked-up law keeps to the stages, and the flight with it.
    stages = None if grid is None or laws is None else grid.stages
    return _scan(sample, start, (count, times[:-1], times[1:], stages, laws))


class Clock(eqx.Module):
    """The clock of a flight whose end its law decides: the time, whether the sample under way is
    meant to be the last, and whether the end was reached."""

    t: Float[Array, ""]
    ending: Bool[Array, ""]
    done: Bool[Array, ""]


def _until_arrival(
    mission: Mission, key: Any, start: Loop, save: bool
) -> tuple[Loop, Any, Float[Array, " instant"]]:
    """The loop at the end that the law decides, what was saved, and the times of the samples.

    **Raises:** `ValueError` for a law whose commands know no time to go.
    """

    def sample(carry: tuple[Loop, Clock], k: Array) -> tuple[tuple[Loop, Clock], Any]:
        loop, clock = carry
        t = clock.t
        command, loop = asked(mission, mission.law, key, loop, k, t)
        if command.time_to_go is None:
            raise ValueError(
                f"{type(mission.law).__name__} decides the end of its flight, but the time_to_go "
                f"of its {type(command).__name__} is None; give the time to go in the command."
            )
        clock = _advanced(mission, clock, command.time_to_go)
        span = Span(k, t, clock.t, None, clock.ending)
        loop, out = flown_across(mission, key, loop, command, span, save)
        return (loop, clock), (out, t)

    never = jnp.array(False)
    clock = Clock(mission.initial_time, never, never)
    (end, clock), (out, when) = _scan(sample, (start, clock), jnp.arange(mission.max_samples))
    late = ~clock.done & (end.result == RESULTS.successful)
    result = RESULTS.where(late, RESULTS.end_not_reached, end.result)
    end = Loop(end.x, end.memories, end.saturated, result)
    return end, out, jnp.append(when, clock.t)


def _advanced(mission: Mission, clock: Clock, to_go: Array) -> Clock:
    """The clock one interval further, or at the end if that is nearer. Where the law finds that the
    end has passed, the clock goes back by that much, once (thesis, section 4.5).

    A remainder that counts as no time to go is still flown: the end's derivatives are in it.
    """
    step = jnp.minimum(mission.sample_interval, to_go)
    step = jnp.minimum(step, mission.final_time - clock.t)
    step = jnp.where(clock.done, jnp.zeros_like(step), step).astype(clock.t.dtype)
    rounding = 8 * jnp.finfo(clock.t.dtype).eps * jnp.abs(mission.final_time)
    near = jnp.maximum(_OVER * mission.sample_interval, rounding)
    arrived = clock.done | (to_go < near)
    return Clock(clock.t + step, to_go <= mission.sample_interval, arrived)


def _arrived(mission: Mission, x0: Array, xf: Array, tf: Array) -> Bool[Array, ""]:
    """Whether the endpoint constraints hold to within `mission.miss`."""
    plant = mission.plant
    e = plant.endpoint_constraints(x0, xf, mission.initial_time, tf)
    off = overstep(e, plant.endpoint_bounds)
    return jnp.all(off <= jnp.asarray(mission.miss, e.dtype))


def sample_times(mission: Mission) -> Float[Array, " instant"]:
    """Times (K+1,) of the samples and of the end: min(t0 + k interval, tf) for k = 0 ...
    max_samples, or the sums of the given lengths; the last is tf."""
    if mission.sample_interval.ndim:
        passed = jnp.pad(jnp.cumsum(mission.sample_interval), (1, 0))
    else:
        count = jnp.arange(mission.max_samples + 1).astype(mission.initial_state.dtype)
        passed = mission.sample_interval * count
    times = mission.initial_time + passed
    return jnp.minimum(times, mission.final_time).at[-1].set(mission.final_time)
