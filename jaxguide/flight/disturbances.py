"""Disturbances: what is added to the rate of the plant's state in flight."""

import abc
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from jaxguide.laws.plain import Plain


class Disturbance(eqx.Module):
    """Abstract: a rate added to dx/dt. Without memory, a function `disturbance(t, x) -> dx/dt` does
    as well.

    It is called wherever the integrator asks for the rate, each time with the key and the memory of
    the sample's beginning, so that within a sample it is one function of t and x. It is also called
    once at the sample's beginning: the memory returned then is the next sample's. `memory` is a
    pytree that keeps its structure, shapes and dtypes (the strength of a gust, say), None if
    nothing is remembered. The methods must work under `jit`, `vmap` and `grad`, and never raise for
    the value of a number.
    """

    # Whether the keys are used: a mission with such a disturbance cannot be flown without one.
    random: ClassVar[bool] = True

    @abc.abstractmethod
    def start(self, key: Any, x0: Float[Array, " n"]) -> Any:
        """The memory of the first sample.

        **Arguments:** `key`: a PRNG key of this call's own, None where `random` is False; `x0`
        (n,): the state at which the flight begins.
        """

    @abc.abstractmethod
    def __call__(
        self, key: Any, t: Any, x: Float[Array, " n"], memory: Any
    ) -> tuple[Float[Array, " n"], Any]:
        """What is added to dx/dt.

        **Arguments:** `key`: a PRNG key of this sample's own, the same at every call within it,
        None where `random` is False; `t` (): any time from the sample to the next; `x` (n,): the
        state there; `memory`: that of the sample's beginning.

        **Returns:** (n,), in units of the state per unit of time; and the memory of the next
        sample, which is kept from the call at the sample's beginning alone.
        """


class PlainDisturbance(Plain, Disturbance):
    """A function `disturbance(t, x) -> dx/dt` as a Disturbance."""

    random: ClassVar[bool] = False

    def start(self, key: None, x0: Float[Array, " n"]) -> None:
        return None

    def __call__(
        self, key: None, t: Any, x: Float[Array, " n"], memory: None
    ) -> tuple[Float[Array, " n"], None]:
        return self.function(t, x), None
