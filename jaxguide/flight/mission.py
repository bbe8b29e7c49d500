"""Mission: the closed loop as one object."""

import difflib
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxguide.flight.integrators import Integrator, RungeKutta4
from jaxguide.laws.holds import HoldDeviation
from jaxguide.laws.law import Law
from jaxguide.problem import Problem, is_free, with_array_leaves
from jaxguide.types import is_traced


class Mission(eqx.Module):
    """A plant flown by a law that samples it: one pytree, every part dispersible.

    **Arguments:**

    - `plant`: a Problem; only its dynamics are used. It may differ from the law's own model.
    - `law`: measurement -> command over the next sample.
    - `initial_state` (n,), `sample_interval`: samples at min(t0 + k interval, tf). Or a vector (K,)
      of the lengths of K samples, one after another, which add up to the horizon; a sample of no
      length is none (derivatives: along lengths that keep adding up). Not for a law that decides
      the end.
    - `hold`: what of the command is flown until the next sample (default: zero-order hold of the
      deviation). `last`: the hold of the sample that ends the flight (default: the same).
    - `sensor(key, t, x)`: the measurement (default: the state).
    - `estimator`: `start(x0) -> memory`, `estimator(t, y, memory) -> (x, memory)`.
    - `delay`: not yet; must be 0.
    - `disturbance(t, x)`: added to dx/dt.
    - `initial_time`, `final_time`: default the plant's; a free final time must be given here. For
      a law that decides the end (`law.decides_end`): the latest, default half as long again as its
      nominal.
    - `miss`: how far the endpoint constraints may be off, each or all, before a flight counts as
      `missed`; default: no matter.
    - `max_samples`: static; default from the horizon and the interval.
    - `integrator`: `RungeKutta4(steps)` (fixed steps, for batches) or `Adaptive(tolerance)`.

    **Raises:** `ValueError` naming the argument, its value and the remedy.
    """

    plant: Problem
    law: Law
    initial_state: Array
    sample_interval: Array
    hold: Any
    last: Any
    sensor: Any
    estimator: Any
    disturbance: Any
    initial_time: Array
    final_time: Array
    miss: Any
    integrator: Integrator
    max_samples: int = eqx.field(static=True)

    def __init__(
        self,
        plant: Problem,
        law: Law,
        initial_state: Any,
        sample_interval: Any,
        *,
        hold: Any = None,
        last: Any = None,
        sensor: Any = None,
        estimator: Any = None,
        delay: float = 0.0,
        disturbance: Any = None,
        initial_time: Any = None,
        final_time: Any = None,
        miss: Any = None,
        max_samples: int | None = None,
        integrator: Integrator | None = None,
    ):
        if not isinstance(delay, (int, float)) or delay != 0.0:
            raise ValueError(
                f"Mission: delay is {delay!r}, but commands take effect at once in this version; "
                "leave it 0."
            )
        initial_time = plant.initial_time if initial_time is None else initial_time
        if final_time is None:
            final_time = _latest(law, initial_time) if law.decides_end else plant.final_time
        for name, value in (("initial_time", initial_time), ("final_time", final_time)):
            if is_free(value):
                raise ValueError(
                    f"Mission: the plant's {name} is free; pass {name}=extremal.{name}, say."
                )
        n = plant.n
        initial_state = jnp.asarray(initial_state)
        if not jnp.issubdtype(initial_state.dtype, jnp.floating):
            initial_state = initial_state.astype(jnp.result_type(float))
        if initial_state.shape != (n,):
            raise ValueError(
                f"Mission: initial_state has shape {initial_state.shape}; give {n} numbers, one "
                f"for each of {plant.state_names}."
            )
        dtype = initial_state.dtype
        self.plant = with_array_leaves(plant)
        # Numbers a user wrote become arrays; functions (a sensor, say) stay.
        to_array = lambda a: jnp.asarray(a) if isinstance(a, (int, float, np.ndarray)) else a
        self.law = jax.tree_util.tree_map(to_array, law)
        self.initial_state = initial_state
        self.sample_interval = jnp.asarray(sample_interval, dtype)
        self.hold = HoldDeviation() if hold is None else hold
        self.last = last  # None: the same hold
        self.sensor, self.estimator, self.disturbance = sensor, estimator, disturbance
        self.initial_time = jnp.asarray(initial_time, dtype)
        self.final_time = jnp.asarray(final_time, dtype)
        self.miss = None if miss is None else jnp.asarray(miss, dtype)
        self.integrator = RungeKutta4() if integrator is None else integrator
        if self.sample_interval.ndim:
            max_samples = _one_length_each(self, max_samples)
        traced = is_traced((self.sample_interval, self.initial_time, self.final_time))
        if not traced and not self.sample_interval.ndim:
            count = _sample_count(
                float(np.asarray(sample_interval)),
                float(np.asarray(initial_time)),
                float(np.asarray(final_time)),
            )
            count += _LAST_STEPS if law.decides_end else 0
            if max_samples is not None and max_samples < count:
                raise ValueError(
                    f"Mission: max_samples is {max_samples}, but the horizon holds {count} "
                    "samples; give at least as many, or leave it out."
                )
            max_samples = count if max_samples is None else max_samples
        if max_samples is None:
            raise ValueError(
                "Mission: max_samples must be given when the sample interval or the horizon is "
                "traced (it fixes the shape of a flight)."
            )
        if max_samples < 1:
            raise ValueError(f"Mission: max_samples is {max_samples}; give at least 1.")
        self.max_samples = max_samples
        if not is_traced(initial_state) and not np.all(np.isfinite(np.asarray(initial_state))):
            i = int(np.argmin(np.isfinite(np.asarray(initial_state))))
            raise ValueError(
                f"Mission: initial_state has {plant.state_names[i]} = {float(initial_state[i])}; "
                "give finite numbers."
            )


_LAST_STEPS = 8  # shorter and shorter ones, in which a law that decides the end closes in on it


def _latest(law: Any, initial_time: Any) -> Any:
    return initial_time + 1.5 * law.schedule.duration


def _one_length_each(mission: Mission, max_samples: int | None) -> int:
    lengths = mission.sample_interval
    if lengths.ndim != 1 or not lengths.size or max_samples not in (None, lengths.size):
        raise ValueError(
            f"Mission: sample_interval has shape {lengths.shape} and max_samples is {max_samples}; "
            "give one number, or a vector of the lengths of all samples and no max_samples."
        )
    if mission.law.decides_end:
        raise ValueError(
            f"Mission: {type(mission.law).__name__} decides the end of its flight, so the lengths "
            "of its samples cannot be given ahead; give one sample_interval."
        )
    if not is_traced((lengths, mission.initial_time, mission.final_time)):
        host, span = np.asarray(lengths), float(mission.final_time - mission.initial_time)
        if not np.all(np.isfinite(host)) or np.any(host < 0):
            k = int(np.argmax(~np.isfinite(host) | (host < 0)))
            raise ValueError(
                f"Mission: sample_interval[{k}] is {host[k]}; give finite lengths, none below 0."
            )
        slack = 4 * lengths.size * float(jnp.finfo(lengths.dtype).eps)
        if abs(host.sum() - span) > slack * abs(span):
            raise ValueError(
                f"Mission: sample_interval adds up to {host.sum()}, but the horizon is {span} "
                "long; scale the lengths to it."
            )
    return lengths.size


def _sample_count(interval: float, t0: float, tf: float) -> int:
    if not (math.isfinite(t0) and math.isfinite(tf)) or not tf > t0:
        raise ValueError(
            f"Mission: the horizon [{t0}, {tf}] must be finite and of positive length."
        )
    if not interval > 0 or not math.isfinite(interval):
        raise ValueError(f"Mission: sample_interval is {interval}; give a positive number.")
    if interval > (tf - t0) * (1 + 1e-12):
        raise ValueError(
            f"Mission: sample_interval {interval} is longer than the horizon {tf - t0}; give at "
            "most the horizon (one sample)."
        )
    return math.ceil((tf - t0) / interval - 1e-9)


def with_leaf(tree: Any, path: str, change: Any) -> Any:
    """`tree` with the leaf at a dotted `path` (as "plant.thrust") replaced by `change(leaf)`.

    **Raises:** `ValueError` for a path that does not exist.
    """
    parts = path.split(".")

    def where(node: Any) -> Any:
        for part in parts:
            if isinstance(node, (tuple, list)) and part.isdigit() and int(part) < len(node):
                node = node[int(part)]
            elif hasattr(node, part):
                node = getattr(node, part)
            else:
                names = [k for k in getattr(node, "__dataclass_fields__", {})]
                near = difflib.get_close_matches(part, names, 1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                there = ", ".join(names)
                raise ValueError(f"no {part!r} in {path!r}; there are {there}{hint or '.'}")
        return node

    leaf = where(tree)
    if leaf is None or isinstance(leaf, (int, str)) or len(jax.tree_util.tree_leaves(leaf)) != 1:
        raise ValueError(f"{path!r} is not one array of the mission; name a leaf below it.")
    return eqx.tree_at(where, tree, change(leaf))
