"""`jg.simulate`: one closed-loop flight, pure, differentiable, and fast under `vmap`."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.bounds import overstep
from jaxguide.flight.integrators import Adaptive, RungeKutta4, stacked
from jaxguide.flight.mission import Mission
from jaxguide.laws.lanes import SampleGrid
from jaxguide.laws.law import Command, Law
from jaxguide.types import RESULTS

# Of the sample interval: a law's time to go below which a flight is done (thesis: 1e-6 s of 4).
END = 2.5e-7


class Flight(eqx.Module):
    """What was flown. With `save="ends"` the histories hold the first and last sample only.

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


class _Carry(eqx.Module):
    x: tuple[Array, ...]
    memory: Any
    estimate: Any
    saturated: Array
    result: RESULTS


class Prepared(NamedTuple):
    """Sample times of a mission and its law made ready for them: shared by a batch of flights."""

    times: Float[Array, " instant"]
    grid: SampleGrid
    laws: Law | None


def prepare(mission: Mission) -> Prepared:
    """The part of a fixed-step flight that depends on time alone."""
    times = sample_times(mission)
    fixed = isinstance(mission.integrator, RungeKutta4)
    stages = jnp.asarray(mission.integrator.stages or (0.0, 1.0), times.dtype)
    grid = SampleGrid(times[:-1], times[:-1, None] + jnp.diff(times)[:, None] * stages[None, :])
    histories = any(hold is not None and hold.uses_history for hold in (mission.hold, mission.last))
    return Prepared(times, grid, mission.law.prepared(grid, histories) if fixed else None)


def simulate(
    mission: Mission, key: Any = None, save: str = "samples", prepared: Prepared | None = None
) -> Flight:
    """Flies `mission` once.

    **Arguments:** `key`: a PRNG key, needed only by a sensor; `save`: "samples" or "ends";
    `prepared`: `prepare(mission)` if at hand (for batches that share times and law).

    **Returns:** a Flight. `.result` is `diverged` where the state left finite numbers (the state is
    then held at its last finite value), `outside_horizon` where the law was asked past its nominal,
    `end_not_reached` where a law that decides the end did not, `missed` where the end is off.

    **Error:** fixed steps: fourth order in sample_interval / steps; Adaptive: its tolerance.
    Differentiable in every leaf of the mission, the sample interval included (between the values
    at which the number of samples jumps), and the lengths of samples given one by one.
    """
    if save not in ("samples", "ends"):
        raise ValueError(f"save is {save!r}; choose 'samples' or 'ends'.")
    if mission.sensor is not None and key is None:
        raise ValueError("simulate: the mission has a sensor, which needs a PRNG key; pass key=.")
    times, grid, laws = prepare(mission) if prepared is None else prepared
    law, fixed = mission.law, isinstance(mission.integrator, RungeKutta4)
    x0 = mission.initial_state

    def ask(law_k: Law, carry: _Carry, k: Array, t: Array) -> tuple[Array, Command, Any, Any]:
        x = jnp.stack(carry.x)
        y, estimate = x, carry.estimate
        if mission.sensor is not None:
            y = mission.sensor(jax.random.fold_in(key, k), t, x)
        if mission.estimator is not None:
            y, estimate = mission.estimator(t, y, estimate)
        command, memory = law_k(t, y, carry.memory)
        return x, command, memory, estimate

    def advance(
        carry: _Carry,
        asked: tuple[Array, Command, Any, Any],
        is_last: Array,
        t: Array,
        t_next: Array,
        stage_times: Array,
        live: Array,
    ) -> tuple[_Carry, Any]:
        x, command, memory, estimate = asked
        flown = mission.hold(command, t)
        if fixed:
            new = _fixed(mission, flown, command, is_last, t, t_next, stage_times, carry.x)
        else:
            new = _adaptive(mission, flown, command, is_last, t, t_next, x)
        finite = jnp.isfinite(sum(new[1:], new[0]))  # one test: NaN and inf survive a sum
        finite = finite & (carry.result != RESULTS.diverged)  # once diverged, held
        new = tuple(jnp.where(finite, b, a) for a, b in zip(carry.x, new, strict=True))
        result = RESULTS.where(carry.result == RESULTS.successful, command.result, carry.result)
        result = RESULTS.where(finite, result, RESULTS.diverged)
        saturated = carry.saturated + jnp.where(
            live & command.saturated, jnp.ones((), x.dtype), jnp.zeros((), x.dtype)
        )
        out = (x, flown(t), flown.deviation(t)) if save == "samples" else None
        keep = RESULTS.where(live, result, carry.result)
        return _Carry(new, memory, estimate, saturated, keep), out

    def sample(carry: _Carry, item: tuple) -> tuple[_Carry, Any]:
        k, t, t_next, stage_times, law_k = item
        asked = ask(law if law_k is None else law_k, carry, k, t)
        is_last = k == mission.max_samples - 1
        return advance(carry, asked, is_last, t, t_next, stage_times, t_next > t)

    def sample_to_go(carry: tuple[_Carry, Clock], k: Array) -> tuple[tuple[_Carry, Clock], Any]:
        flying, clock = carry
        t = clock.t
        asked = ask(law, flying, k, t)
        clock = _advanced(mission, clock, asked[1].time_to_go)
        stages = jnp.asarray(mission.integrator.stages or (0.0, 1.0), t.dtype)
        within = t + (clock.t - t) * stages
        flying, out = advance(flying, asked, clock.ending, t, clock.t, within, clock.t != t)
        return (flying, clock), (out, t)

    estimate = None if mission.estimator is None else mission.estimator.start(x0)
    start = _Carry(
        tuple(x0[i] for i in range(x0.shape[0])),
        law.start(x0),
        estimate,
        jnp.zeros((), x0.dtype),
        RESULTS.where(jnp.array(True), RESULTS.successful, RESULTS.successful),
    )
    count = jnp.arange(mission.max_samples)
    # Checkpointed: reverse mode keeps the state at each sample and flies the sample again.
    checkpoint = lambda f: jax.checkpoint(f, prevent_cse=False)  # pyright: ignore
    if law.decides_end:
        never = jnp.array(False)
        begin = Clock(mission.initial_time, never, never)
        (end, clock), (saved, when) = jax.lax.scan(checkpoint(sample_to_go), (start, begin), count)
        late = ~clock.done & (end.result == RESULTS.successful)
        result = RESULTS.where(late, RESULTS.end_not_reached, end.result)
        end = eqx.tree_at(lambda e: e.result, end, result)
        times = jnp.append(when, clock.t)
    else:
        items = (count, times[:-1], times[1:], grid.stages, laws)
        end, saved = jax.lax.scan(checkpoint(sample), start, items)
    final = jnp.stack(end.x)
    result = end.result
    if mission.miss is not None:
        arrived = result == RESULTS.successful
        missed = arrived & ~_arrived(mission, x0, final, times[-1])
        result = RESULTS.where(missed, RESULTS.missed, result)
    if save == "samples":
        xs, us, dus = saved
        t, x = times, jnp.concatenate([xs, final[None]])
    else:
        t, x = jnp.stack([times[0], times[-1]]), jnp.stack([x0, final])
        us = dus = jnp.zeros((1, mission.plant.m), x0.dtype)
    return Flight(t, x, us, dus, final, times[-1], end.saturated, result)


class Clock(eqx.Module):
    """Of a flight whose end its law decides."""

    t: Float[Array, ""]
    ending: Bool[Array, ""]  # this step is meant to be the last
    done: Bool[Array, ""]


def _advanced(mission: Mission, clock: Clock, to_go: Array) -> Clock:
    """One interval on, or as far as there is to go, until nothing is left; where the law finds
    itself past its end, once back by that much (thesis, section 4.5).

    What counts as nothing is still flown: the end's derivatives are in it.
    """
    step = jnp.minimum(mission.sample_interval, to_go)
    step = jnp.minimum(step, mission.final_time - clock.t)
    step = jnp.where(clock.done, jnp.zeros_like(step), step).astype(clock.t.dtype)
    rounding = 8 * jnp.finfo(clock.t.dtype).eps * jnp.abs(mission.final_time)
    near = jnp.maximum(END * mission.sample_interval, rounding)
    arrived = clock.done | (to_go < near)
    return Clock(clock.t + step, to_go <= mission.sample_interval, arrived)


def _arrived(mission: Mission, x0: Array, xf: Array, tf: Array) -> Bool[Array, ""]:
    """Whether the endpoint constraints hold to within `mission.miss`."""
    plant = mission.plant
    e = plant.endpoint_constraints(x0, xf, mission.initial_time, tf)
    off = overstep(e, plant.endpoint_bounds)
    return jnp.all(off <= jnp.asarray(mission.miss, e.dtype))


def sample_times(mission: Mission) -> Float[Array, " instant"]:
    """min(t0 + k interval, tf) for k = 0 ... max_samples, or after each given length; the last is
    tf."""
    if mission.sample_interval.ndim:
        passed = jnp.pad(jnp.cumsum(mission.sample_interval), (1, 0))
    else:
        count = jnp.arange(mission.max_samples + 1).astype(mission.initial_state.dtype)
        passed = mission.sample_interval * count
    times = mission.initial_time + passed
    return jnp.minimum(times, mission.final_time).at[-1].set(mission.final_time)


def _fixed(
    mission: Mission,
    flown: Command,
    command: Command,
    is_last: Bool[Array, ""],
    t: Array,
    t_next: Array,
    stage_times: Array,
    x: tuple[Array, ...],
) -> tuple[Array, ...]:
    nominal, deviation = flown.nominal_on(stage_times), flown.deviation_on(stage_times)
    if mission.last is not None:
        other = mission.last(command, t)
        choose = lambda a, b: jax.tree_util.tree_map(lambda a, b: jnp.where(is_last, a, b), a, b)
        full = lambda d: d * (stage_times.shape[0] if len(d) == 1 else 1)
        nominal = choose(other.nominal_on(stage_times), nominal)
        deviation = choose(full(other.deviation_on(stage_times)), full(deviation))
    plant, disturbance = mission.plant, mission.disturbance

    def rate(t: Any, x: Array, u: Array) -> Array:
        dx = plant.dynamics(t, x, u)
        return dx if disturbance is None else dx + disturbance(t, x)

    assert isinstance(mission.integrator, RungeKutta4)
    return mission.integrator.across(stacked(rate), t, t_next - t, x, nominal, deviation)


def _adaptive(
    mission: Mission,
    flown: Command,
    command: Command,
    is_last: Bool[Array, ""],
    t: Array,
    t_next: Array,
    x: Array,
) -> tuple[Array, ...]:
    plant, disturbance = mission.plant, mission.disturbance
    last = mission.last(command, t) if mission.last is not None else None

    def rate(t: Any, x: Array) -> Array:
        u = flown(t) if last is None else jnp.where(is_last, last(t), flown(t))
        dx = plant.dynamics(t, x, u)
        return dx if disturbance is None else dx + disturbance(t, x)

    assert isinstance(mission.integrator, Adaptive)
    # A sample beyond the end has no length, which an adaptive solver does not take.
    width = jnp.where(t_next != t, t_next - t, 1.0)
    final, result = mission.integrator.across(rate, t, t + width, x)
    good = (result == RESULTS.successful) & jnp.all(jnp.isfinite(final))
    final = jnp.where(good, final, jnp.nan)
    final = jnp.where(t_next != t, final, x)
    return tuple(final[i] for i in range(final.shape[0]))
