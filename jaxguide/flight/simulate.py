"""`jg.simulate`: one closed-loop flight, pure, differentiable, and fast under `vmap`."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.flight.integrators import Adaptive, RungeKutta4, stacked
from jaxguide.flight.mission import Mission
from jaxguide.laws.law import Command, Law, SampleGrid
from jaxguide.types import RESULTS


class Flight(eqx.Module):
    """What was flown. With `save="ends"` the histories hold the first and last sample only.

    `t` (K+1,), `x` (K+1, n) at sample times and the end; `u` (K, m) and `commands` (K, m), the
    control and its deviation as commanded at each sample; `saturated` (): samples at the cap.
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
    then held at its last finite value), `outside_horizon` where the law was asked past its nominal.

    **Error:** fixed steps: fourth order in sample_interval / steps; Adaptive: its tolerance.
    Differentiable in every leaf of the mission, the sample interval included (between the values
    at which the number of samples jumps).
    """
    if save not in ("samples", "ends"):
        raise ValueError(f"save is {save!r}; choose 'samples' or 'ends'.")
    if mission.sensor is not None and key is None:
        raise ValueError("simulate: the mission has a sensor, which needs a PRNG key; pass key=.")
    times, grid, laws = prepare(mission) if prepared is None else prepared
    law, fixed = mission.law, isinstance(mission.integrator, RungeKutta4)
    x0 = mission.initial_state

    def sample(carry: _Carry, item: tuple) -> tuple[_Carry, Any]:
        k, t, t_next, stage_times, law_k = item
        law_k = law if law_k is None else law_k
        x = jnp.stack(carry.x)
        y, estimate = x, carry.estimate
        if mission.sensor is not None:
            y = mission.sensor(jax.random.fold_in(key, k), t, x)
        if mission.estimator is not None:
            y, estimate = mission.estimator(t, y, estimate)
        command, memory = law_k(t, y, carry.memory)
        flown = mission.hold(command, t)
        is_last = k == mission.max_samples - 1
        if fixed:
            new = _fixed(mission, flown, command, is_last, t, t_next, stage_times, carry.x)
        else:
            new = _adaptive(mission, flown, command, is_last, t, t_next, x)
        finite = jnp.isfinite(sum(new[1:], new[0]))  # one test: NaN and inf survive a sum
        finite = finite & (carry.result != RESULTS.diverged)  # once diverged, held
        new = tuple(jnp.where(finite, b, a) for a, b in zip(carry.x, new, strict=True))
        result = RESULTS.where(carry.result == RESULTS.successful, command.result, carry.result)
        result = RESULTS.where(finite, result, RESULTS.diverged)
        live = t_next > t
        saturated = carry.saturated + jnp.where(
            live & command.saturated, jnp.ones((), x.dtype), jnp.zeros((), x.dtype)
        )
        out = (x, flown(t), flown.deviation(t)) if save == "samples" else None
        keep = RESULTS.where(live, result, carry.result)
        return _Carry(new, memory, estimate, saturated, keep), out

    estimate = None if mission.estimator is None else mission.estimator.start(x0)
    start = _Carry(
        tuple(x0[i] for i in range(x0.shape[0])),
        law.start(x0),
        estimate,
        jnp.zeros((), x0.dtype),
        RESULTS.where(jnp.array(True), RESULTS.successful, RESULTS.successful),
    )
    count = jnp.arange(mission.max_samples)
    items = (count, times[:-1], times[1:], grid.stages, laws)
    # Checkpointed: reverse mode keeps the state at each sample and flies the sample again.
    body = jax.checkpoint(sample, prevent_cse=False)  # pyright: ignore
    end, saved = jax.lax.scan(body, start, items)
    final = jnp.stack(end.x)
    if save == "samples":
        xs, us, dus = saved
        t, x = times, jnp.concatenate([xs, final[None]])
    else:
        t, x = jnp.stack([times[0], times[-1]]), jnp.stack([x0, final])
        us = dus = jnp.zeros((1, mission.plant.m), x0.dtype)
    return Flight(t, x, us, dus, final, times[-1], end.saturated, end.result)


def sample_times(mission: Mission) -> Float[Array, " instant"]:
    """min(t0 + k interval, tf) for k = 0 ... max_samples; the last is tf."""
    count = jnp.arange(mission.max_samples + 1).astype(mission.initial_state.dtype)
    times = mission.initial_time + mission.sample_interval * count
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
    width = jnp.where(t_next > t, t_next - t, 1.0)
    final, result = mission.integrator.across(rate, t, t + width, x)
    good = (result == RESULTS.successful) & jnp.all(jnp.isfinite(final))
    final = jnp.where(good, final, jnp.nan)
    final = jnp.where(t_next > t, final, x)
    return tuple(final[i] for i in range(final.shape[0]))
