"""What is flown of a command until the next sample."""

import abc
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Bool, Float

from jaxguide.laws.lanes import Lanes, lanes
from jaxguide.laws.law import Command
from jaxguide.types import RESULTS


class Hold(eqx.Module):
    """Turns a law's command into what the vehicle does over the sample that begins at `t_k`."""

    uses_history: ClassVar[bool] = False  # whether the command's deviation is asked after t_k

    @abc.abstractmethod
    def __call__(self, command: Command, t_k: Any) -> Command:
        """The command as flown."""


class History(Hold):
    """The law's own open-loop history of the deviation (2002 paper, eq. 49)."""

    uses_history: ClassVar[bool] = True

    def __call__(self, command: Command, t_k: Any) -> Command:
        return command


class HoldDeviation(Hold):
    """Zero-order hold of the deviation: u = u*(t) + du(t_k)."""

    def __call__(self, command: Command, t_k: Any) -> Command:
        return _HeldDeviation(
            command=command,
            du=command.deviation(t_k),
            result=command.result,
            saturated=command.saturated,
        )


class HoldControl(Hold):
    """Zero-order hold of the whole control: u = u*(t_k) + du(t_k)."""

    def __call__(self, command: Command, t_k: Any) -> Command:
        return _HeldControl(
            u=command.nominal(t_k),
            du=command.deviation(t_k),
            result=command.result,
            saturated=command.saturated,
        )


class _HeldDeviation(Command):
    command: Command
    du: Float[Array, " m"]
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.command.nominal(t)

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self.du

    def nominal_on(self, times: Array) -> tuple[Lanes, ...]:
        return self.command.nominal_on(times)

    def deviation_on(self, times: Array) -> tuple[Lanes, ...]:
        return (lanes(self.du),)


class _HeldControl(Command):
    u: Float[Array, " m"]
    du: Float[Array, " m"]
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.u

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self.du

    def deviation_on(self, times: Array) -> tuple[Lanes, ...]:
        return (lanes(self.du),)
