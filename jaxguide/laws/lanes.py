"""The fast path of a batch of flights: vectors as tuples of scalars, laws looked up once on a grid
of times.

None of this is needed to write a law, a hold, an actuator or an integrator. All flights of a batch
share their sample times, so a law's gains and nominal may be looked up once for all of them, at the
sample times and at the times where a fixed-step integrator asks for the control (its stages). That
is done where the law, its holds, the actuator and the integrator of a mission all know how: each by
deriving from one of the abstract classes below and of `jaxguide.flight`. Otherwise the mission is
flown by the plain contracts, with the same result to rounding.
"""

import abc
from typing import Any, ClassVar, TypeGuard, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from jaxguide.laws.law import Command, Hold, Law

# A vector as a tuple of scalars: under `vmap` each becomes one contiguous array of flights, which
# is what makes a batch of flights fast on a CPU.
Lanes = tuple[Any, ...]
Known = TypeVar("Known", bound=eqx.Module)


def lanes(vector: Float[Array, " k"]) -> Lanes:
    """The entries of `vector`, as a tuple."""
    return tuple(vector[i] for i in range(vector.shape[0]))


class SampleGrid(eqx.Module):
    """The sample times of a flight, and the times of the integrator's stages within each sample."""

    times: Float[Array, " sample"]
    stages: Float[Array, "sample stage"]


class StagedCommand(Command):
    """Abstract: a command known at the sample and at the stages of the integrator.

    `nominal`, `deviation` and the call need be right at the sample alone. The control flown is the
    sum of `nominal_on` and `deviation_on`.
    """

    @abc.abstractmethod
    def nominal_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        """The nominal control at each of the sample's stage times `times`."""

    @abc.abstractmethod
    def deviation_on(self, times: Float[Array, " stage"]) -> tuple[Lanes, ...]:
        """The deviation at each stage time; one entry alone if it is constant over the sample."""


class GridLaw(Law):
    """Abstract: a law that can be looked up on a grid of times."""

    @abc.abstractmethod
    def prepared(self, grid: SampleGrid, histories: bool) -> Law:
        """A law with a leading sample axis on every leaf, whose work that depends on time alone is
        done. The law of one sample (every leaf at one index) gives StagedCommands.

        `histories`: whether the deviation will be asked for after the sample (a zero-order hold
        asks for its value at the sample alone).
        """


class StagedHold(Hold):
    """Abstract: a hold that asks a command for its control at the sample and at the stages alone,
    and makes a StagedCommand of a StagedCommand."""

    uses_history: ClassVar[bool] = False  # whether it asks for the deviation after the sample


def staged(command: Command) -> StagedCommand:
    """`command`, which must be known at stages.

    **Raises:** `TypeError` where a part of the fast path was handed a command of the plain one.
    """
    if not isinstance(command, StagedCommand):
        raise TypeError(f"{type(command).__name__} is not known at an integrator's stages.")
    return command


def vouches(part: Any, contract: type[Known], method: str = "__call__") -> TypeGuard[Known]:
    """Whether `part` keeps the fast path's `contract`: the class that defines its `method` derives
    from the contract directly. One that derives from such a class and writes the method anew does
    not vouch for it, and is flown by the plain contracts."""
    author = next((c for c in type(part).__mro__ if method in c.__dict__), None)
    return author is not None and contract in author.__bases__
