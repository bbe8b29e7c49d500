"""What a guidance law is: a measurement in, a command over the next sample out."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.laws.lanes import Lanes, SampleGrid, lanes
from jaxguide.types import RESULTS


class Command(eqx.Module):
    """A control over the next sample, its nominal and its deviation kept apart."""

    result: eqx.AbstractVar[RESULTS]
    saturated: eqx.AbstractVar[Bool[Array, ""]]

    @abc.abstractmethod
    def nominal(self, t: Any) -> Float[Array, " m"]:
        """The nominal control at `t`."""

    @abc.abstractmethod
    def deviation(self, t: Any) -> Float[Array, " m"]:
        """What the law adds to it at `t`."""

    def __call__(self, t: Any) -> Float[Array, " m"]:
        return self.nominal(t) + self.deviation(t)

    @property
    def time_to_go(self) -> Any:
        """From the sample to the end that the law expects; None: the mission knows its end."""
        return None

    def nominal_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        """`nominal` at each stage time; laws prepared on a grid look it up."""
        return tuple(lanes(self.nominal(times[j])) for j in range(times.shape[0]))

    def deviation_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        """`deviation` at each stage time; one entry only if it is constant over the sample."""
        return tuple(lanes(self.deviation(times[j])) for j in range(times.shape[0]))


class Law(eqx.Module):
    """A guidance law. `memory` is a pytree of whatever it must remember between samples."""

    decides_end: ClassVar[bool] = False  # whether its commands carry a time to go, to fly to zero

    @abc.abstractmethod
    def start(self, x0: Float[Array, " n"]) -> Any:
        """Memory before the first sample."""

    @abc.abstractmethod
    def __call__(self, t_k: Any, x: Float[Array, " n"], memory: Any) -> tuple[Command, Any]:
        """The command from `t_k` on, given the measured state; and the new memory."""

    def prepared(self, grid: SampleGrid, histories: bool) -> "Law | None":
        """The law with a leading sample axis on every leaf, its time-dependent work done.

        All flights of a batch share their sample times, so gains and nominal are worth looking up
        once. `histories`: whether `deviation_on` will be asked (a hold of the deviation asks only
        for its value at the sample). None (the default): nothing to prepare.
        """
        return None


class OpenLoop(Law):
    """Flies the nominal control and looks at nothing."""

    extremal: Any

    def start(self, x0: Array) -> None:
        return None

    def __call__(self, t_k: Any, x: Array, memory: None) -> tuple[Command, None]:
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
