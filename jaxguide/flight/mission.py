"""Mission: the closed loop as one object."""

import difflib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.flight.actuators import Actuator, PlainActuator
from jaxguide.flight.disturbances import Disturbance, PlainDisturbance
from jaxguide.flight.estimators import as_estimator
from jaxguide.flight.horizon import flight_horizon, sample_count
from jaxguide.flight.integrators import Integrator, RungeKutta4
from jaxguide.flight.sensors import PlainSensor, Sensor
from jaxguide.laws.holds import HoldDeviation, PlainHold
from jaxguide.laws.law import Hold, Law
from jaxguide.laws.plain import fulfilled, unwrapped
from jaxguide.problem import Problem, with_array_leaves
from jaxguide.types import as_float, is_traced


class Mission(eqx.Module):
    """A plant flown by a law that samples it: one pytree, every part dispersible.

    **Arguments:**

    - `plant`: a Problem; its dynamics are flown, its bounds limit an actuator, its endpoint
      constraints judge the end. It may differ from the law's own model.
    - `law`: a `jg.Law`, which turns the measurement into the command for the next sample.
    - `initial_state` (n,), `sample_interval`: samples at min(t0 + k interval, tf). Or a vector (K,)
      of the lengths of K samples, one after another, which add up to the horizon; a sample of no
      length is none (derivatives: along lengths that keep adding up). Not for a law that decides
      the end.
    - `hold`: a `jg.Hold` or a function `hold(command, t_k)`: the part of the command that is asked
      for until the next sample (default: zero-order hold of the deviation). `last`: the hold of the
      sample that ends the flight (default: the same).
    - `sensor`: a `jg.Sensor` or a function `sensor(key, t, x)`: the measurement (default: the
      state).
    - `estimator`: a `jg.Estimator` or a function `estimator(t, y)`: the state as the law is given
      it (default: the measurement).
    - `delay`: not yet; must be 0.
    - `actuator`: a `jg.Actuator` or a function `actuator(command, t_k)`: the command that the
      vehicle flies (default: the held one). `jg.ControlLimits()` keeps it within the plant's
      `control_bounds`.
    - `disturbance`: a `jg.Disturbance` or a function `disturbance(t, x)`: added to dx/dt.
    - `initial_time`, `final_time`: default the plant's; a free final time must be given here. For
      a law that decides the end: the latest, default its own `latest_end`.
    - `miss`: by how much the endpoint constraints may be overstepped, each or all, before a flight
      counts as `missed`; default: no limit.
    - `max_samples`: static; default from the horizon and the interval.
    - `integrator`: a `jg.Integrator`: `RungeKutta4(steps)` (fixed steps, for batches; the default),
      `Adaptive(tolerance)`, or the user's own.

    Numbers in any part become arrays.

    **Raises:** `ValueError` naming the argument, its value and the remedy.
    """

    plant: Problem
    law: Law
    initial_state: Float[Array, " n"]
    sample_interval: Array
    hold: Any
    last: Any
    sensor: Any
    estimator: Any
    actuator: Any
    disturbance: Any
    initial_time: Float[Array, ""]
    final_time: Float[Array, ""]
    miss: Any
    integrator: Integrator
    max_samples: int = eqx.field(static=True)

    def __init__(
        self,
        plant: Problem,
        law: Any,
        initial_state: Any,
        sample_interval: Any,
        *,
        hold: Any = None,
        last: Any = None,
        sensor: Any = None,
        estimator: Any = None,
        delay: float = 0.0,
        actuator: Any = None,
        disturbance: Any = None,
        initial_time: Any = None,
        final_time: Any = None,
        miss: Any = None,
        max_samples: int | None = None,
        integrator: Any = None,
    ):
        if not isinstance(delay, (int, float)) or delay != 0.0:
            raise ValueError(
                f"Mission: delay is {delay!r}, but commands take effect at once in this version; "
                "leave it 0."
            )
        initial_time, final_time = flight_horizon(plant, law, initial_time, final_time)
        self.plant = with_array_leaves(plant)
        self.law = _arrays(law)
        self.initial_state = _initial_state(plant, initial_state)
        dtype = self.initial_state.dtype
        self.sample_interval = jnp.asarray(sample_interval, dtype)
        self.hold = _arrays(_hold(HoldDeviation() if hold is None else hold, "hold"))
        self.last = _arrays(_hold(last, "last"))
        sensor = fulfilled(sensor, Sensor, PlainSensor, "sensor", ("key", "t", "x"))
        self.sensor, self.estimator = _arrays(sensor), _arrays(as_estimator(estimator))
        commanded = ("command", "t_k")
        self.actuator = _arrays(fulfilled(actuator, Actuator, PlainActuator, "actuator", commanded))
        self.disturbance = _arrays(
            fulfilled(disturbance, Disturbance, PlainDisturbance, "disturbance", ("t", "x"))
        )
        self.initial_time = jnp.asarray(initial_time, dtype)
        self.final_time = jnp.asarray(final_time, dtype)
        self.miss = None if miss is None else jnp.asarray(miss, dtype)
        given = fulfilled(integrator, Integrator, None, "integrator")
        self.integrator = RungeKutta4() if given is None else given
        self.max_samples = sample_count(
            law, sample_interval, (initial_time, final_time), dtype, max_samples
        )


def _arrays(part: Any) -> Any:
    """`part` with the numbers that a user wrote as arrays; functions stay."""
    to_array = lambda a: jnp.asarray(a) if isinstance(a, (int, float, np.ndarray)) else a
    return jax.tree_util.tree_map(to_array, part)


def _hold(value: Any, role: str) -> Any:
    return fulfilled(value, Hold, PlainHold, role, ("command", "t_k"))


def _initial_state(plant: Problem, initial_state: Any) -> Float[Array, " n"]:
    """`initial_state` as an array of the plant's size, refused with a `ValueError` otherwise."""
    x0 = as_float(jnp.asarray(initial_state))
    if x0.shape != (plant.n,):
        raise ValueError(
            f"Mission: initial_state has shape {x0.shape}; give {plant.n} numbers, one for each of "
            f"{plant.state_names}."
        )
    if not is_traced(x0) and not np.all(np.isfinite(np.asarray(x0))):
        i = int(np.argmin(np.isfinite(np.asarray(x0))))
        raise ValueError(
            f"Mission: initial_state has {plant.state_names[i]} = {float(x0[i])}; give finite "
            "numbers."
        )
    return x0


def with_leaf(tree: Any, path: str, change: Any) -> Any:
    """`tree` with the leaf at a dotted `path` (as "plant.thrust") replaced by `change(leaf)`.

    **Raises:** `ValueError` for a path that does not exist.
    """
    parts = path.split(".")

    def where(node: Any) -> Any:
        for part in parts:
            node = unwrapped(node)
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
