"""The contracts of a guidance law, its command and a hold; and the law without feedback."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.types import RESULTS


class Command(eqx.Module):
    """Abstract: a control for the times from one sample to the next, its nominal and its deviation
    kept apart, so that a hold may treat them differently.

    A subclass is a pytree with two fields of these names, and the two methods below:

    - `result`: `jg.RESULTS.successful`, or why the control is not to be trusted (a flight reports
      the first such reason). A command made from another one carries on the other's.
    - `saturated` (): whether a limit holds the control back at the sample (a flight counts these).

    All times are those of the mission, in its unit; controls are in the units of the plant. A
    method never raises for the value of a number: a state of NaN gives a control of NaN.
    """

    result: eqx.AbstractVar[RESULTS]
    saturated: eqx.AbstractVar[Bool[Array, ""]]

    @abc.abstractmethod
    def nominal(self, t: Any) -> Float[Array, " m"]:
        """The control before any correction.

        **Arguments:** `t` (): any time from the sample to the next, both included.

        **Returns:** (m,), in the dtype of the state.
        """

    @abc.abstractmethod
    def deviation(self, t: Any) -> Float[Array, " m"]:
        """The correction: `t` and shape as for `nominal`."""

    def __call__(self, t: Any) -> Float[Array, " m"]:
        """The whole control at `t`, (m,): the sum of `nominal` and `deviation`."""
        return self.nominal(t) + self.deviation(t)

    @property
    def time_to_go(self) -> Any:
        """Time () from the sample to the end of the flight as the law expects it, at or below zero
        at the end. Needed of a law whose `decides_end` is True; None (the default) otherwise."""
        return None


class Law(eqx.Module):
    """Abstract: a guidance law, which turns a measurement into the command for the next sample.

    `memory` is a pytree that the law carries from one sample to the next, None if it needs none. It
    keeps its structure, shapes and dtypes, since a flight is one `lax.scan`. Both methods must
    work under `jit`, `vmap` and `grad`: no Python branch on the value of an array, and no exception
    for one; the command's `result` says what went wrong.
    """

    # Whether a flight ends when the law's `time_to_go` is zero; otherwise it ends at the mission's
    # `final_time`.
    decides_end: ClassVar[bool] = False

    @abc.abstractmethod
    def start(self, x0: Float[Array, " n"]) -> Any:
        """The memory before the first sample.

        **Arguments:** `x0` (n,): the state at which the flight begins. Use its dtype.
        """

    @abc.abstractmethod
    def __call__(self, t_k: Any, x: Float[Array, " n"], memory: Any) -> tuple[Command, Any]:
        """The command from `t_k` to the next sample.

        **Arguments:** `t_k` (): time of the sample; `x` (n,): the state there, as the estimator
        (or else the sensor) gives it; `memory`: what the last call returned.

        **Returns:** the Command and the new memory.
        """

    def latest_end(self, initial_time: Any) -> Any:
        """Of a law that decides the end: the latest time () at which a flight from `initial_time`
        may end, unless the mission says so. None: the mission must give its `final_time`."""
        return None


class Hold(eqx.Module):
    """Abstract: turns a law's command into the one that is asked of the vehicle until the next
    sample. Without memory, a function `hold(command, t_k) -> Command` does as well.

    `memory` as in `Law`. A hold may ask the command for its control at any time of the sample.
    """

    @abc.abstractmethod
    def start(self) -> Any:
        """The memory before the first sample; None if nothing is remembered."""

    @abc.abstractmethod
    def __call__(self, command: Command, t_k: Any, memory: Any) -> tuple[Command, Any]:
        """The held command from `t_k` to the next sample.

        **Arguments:** `command`: the law's; `t_k` (): time of the sample; `memory`: what the last
        call returned.

        **Returns:** a Command that carries on `command.result` and `command.saturated`, and the new
        memory.
        """


class OpenLoop(Law):
    """Flies the nominal control, without feedback.

    **Arguments:** `extremal`: a `jg.Extremal`, or anything that gives `.u` (m,) at a time.
    """

    extremal: Any

    def start(self, x0: Float[Array, " n"]) -> None:
        return None

    def __call__(
        self, t_k: Any, x: Float[Array, " n"], memory: None
    ) -> tuple["NominalCommand", None]:
        command = NominalCommand(
            extremal=self.extremal, result=RESULTS.successful, saturated=jnp.array(False)
        )
        return command, None


class NominalCommand(Command):
    """The nominal control with no deviation."""

    extremal: Any
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.extremal(t).u

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return jnp.zeros_like(self.extremal.u[0])
