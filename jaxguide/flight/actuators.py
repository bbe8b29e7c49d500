"""Actuators: what the vehicle does when the held command asks for a control."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.bounds import bounds_of, overstep
from jaxguide.laws.lanes import Lanes, StagedCommand, staged
from jaxguide.laws.law import Command
from jaxguide.laws.plain import Plain
from jaxguide.problem import Problem
from jaxguide.types import RESULTS


class Actuator(eqx.Module):
    """Abstract: turns the held command into the one that the vehicle flies. Without memory, a
    function `actuator(command, t_k) -> Command` does as well.

    `memory` is a pytree carried from one sample to the next (the control reached before, say), None
    if nothing is remembered; it keeps its structure, shapes and dtypes. The methods must work
    under `jit`, `vmap` and `grad`, and never raise for the value of a number.
    """

    @abc.abstractmethod
    def start(self, plant: Problem) -> Any:
        """The memory before the first sample.

        **Arguments:** `plant`: the flight's plant, dispersion included: `plant.control_bounds` are
        its limits, `plant.m` is its number of controls.
        """

    @abc.abstractmethod
    def __call__(self, command: Command, t_k: Any, memory: Any) -> tuple[Command, Any]:
        """The command as flown from `t_k` to the next sample.

        **Arguments:** `command`: as held, which may be asked at any time of the sample; `t_k` ():
        time of the sample; `memory`: that of the last call.

        **Returns:** a Command that carries on `command.result` and, unless it limits the control
        itself, `command.saturated`; and the new memory.
        """


class StagedActuator(Actuator):
    """Abstract: an actuator that asks a command for its control at the sample and at the stages
    alone, and makes a StagedCommand of a StagedCommand, for the fast path (see
    `jaxguide.laws.lanes`)."""


class ControlLimits(StagedActuator):
    """Limits the whole control to the plant's `control_bounds`, at every time. A sample at which
    that changes the control counts as saturated."""

    def start(self, plant: Problem) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        low, high = bounds_of(plant.control_bounds, plant.m, jnp.result_type(float))
        return jnp.asarray(low), jnp.asarray(high)

    def __call__(
        self, command: Command, t_k: Any, memory: tuple[Float[Array, " m"], Float[Array, " m"]]
    ) -> tuple["LimitedCommand", tuple[Float[Array, " m"], Float[Array, " m"]]]:
        over = jnp.any(overstep(command(t_k), memory) > 0)
        limited = LimitedCommand(
            command=command,
            limits=memory,
            result=command.result,
            saturated=command.saturated | over,
        )
        return limited, memory


class LimitedCommand(StagedCommand):
    """`command` with its whole control limited; the deviation is that control less the nominal."""

    command: Command
    limits: tuple[Float[Array, " m"], Float[Array, " m"]]
    result: RESULTS
    saturated: Bool[Array, ""]

    def __call__(self, t: Any) -> Float[Array, " m"]:
        # Not as a sum, which might leave the bounds by its rounding.
        u = self.command(t)
        lower, upper = (bound.astype(u.dtype) for bound in self.limits)
        return jnp.clip(u, lower, upper)

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.command.nominal(t)

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self(t) - self.command.nominal(t)

    def nominal_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        # The whole limited control: exactly within the bounds, as no sum would be.
        command = staged(self.command)
        nominal, deviation = command.nominal_on(times), command.deviation_on(times)
        full = deviation * (len(nominal) if len(deviation) == 1 else 1)
        return tuple(self._limited(u, du) for u, du in zip(nominal, full, strict=True))

    def deviation_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        return (tuple(jnp.zeros_like(u) for u in staged(self.command).nominal_on(times)[0]),)

    def _limited(self, u: Lanes, du: Lanes) -> Lanes:
        lower, upper = self.limits
        return tuple(
            jnp.clip(u[i] + du[i], lower[i].astype(u[i].dtype), upper[i].astype(u[i].dtype))
            for i in range(len(u))
        )


class PlainActuator(Plain, Actuator):
    """A function `actuator(command, t_k) -> Command` as an Actuator."""

    def start(self, plant: Problem) -> None:
        return None

    def __call__(self, command: Command, t_k: Any, memory: None) -> tuple[Command, None]:
        return self.function(command, t_k), None
