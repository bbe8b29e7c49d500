"""Holds: the part of a law's command that is flown until the next sample."""

from typing import Any, ClassVar

from jaxtyping import Array, Bool, Float

from jaxguide.laws.lanes import Lanes, StagedCommand, StagedHold, lanes, staged
from jaxguide.laws.law import Command, Hold
from jaxguide.laws.plain import Plain
from jaxguide.types import RESULTS


class History(StagedHold):
    """Flies the whole command: the law's own open-loop history of the deviation (2002 paper,
    eq. (49))."""

    uses_history: ClassVar[bool] = True

    def start(self) -> None:
        return None

    def __call__(self, command: Command, t_k: Any, memory: None) -> tuple[Command, None]:
        return command, None


class HoldDeviation(StagedHold):
    """Zero-order hold of the deviation: u = u*(t) + du(t_k)."""

    def start(self) -> None:
        return None

    def __call__(self, command: Command, t_k: Any, memory: None) -> tuple["HeldDeviation", None]:
        held = HeldDeviation(
            command=command,
            du=command.deviation(t_k),
            result=command.result,
            saturated=command.saturated,
        )
        return held, None


class HoldControl(StagedHold):
    """Zero-order hold of the whole control: u = u*(t_k) + du(t_k)."""

    def start(self) -> None:
        return None

    def __call__(self, command: Command, t_k: Any, memory: None) -> tuple["HeldControl", None]:
        held = HeldControl(
            u=command.nominal(t_k),
            du=command.deviation(t_k),
            result=command.result,
            saturated=command.saturated,
        )
        return held, None


class HeldDeviation(StagedCommand):
    """The nominal of `command` and the deviation `du`, constant over the sample."""

    command: Command
    du: Float[Array, " m"]
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.command.nominal(t)

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self.du

    def nominal_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        return staged(self.command).nominal_on(times)

    def deviation_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        return (lanes(self.du),)


class HeldControl(StagedCommand):
    """The nominal `u` and the deviation `du`, both constant over the sample."""

    u: Float[Array, " m"]
    du: Float[Array, " m"]
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.u

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self.du

    def nominal_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        return (lanes(self.u),) * times.shape[0]

    def deviation_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        return (lanes(self.du),)


class PlainHold(Plain, Hold):
    """A function `hold(command, t_k) -> Command` as a Hold."""

    def start(self) -> None:
        return None

    def __call__(self, command: Command, t_k: Any, memory: None) -> tuple[Command, None]:
        return self.function(command, t_k), None
