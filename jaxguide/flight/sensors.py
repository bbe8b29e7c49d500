"""Sensors: what is measured of the state at a sample."""

import abc
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from jaxguide.laws.plain import Plain


class Sensor(eqx.Module):
    """Abstract: the measurement at each sample. Without memory, a function `sensor(key, t, x) -> y`
    does as well.

    `memory` is a pytree carried from one sample to the next (a bias that wanders, say), None if
    nothing is remembered; it keeps its structure, shapes and dtypes. The methods must work under
    `jit`, `vmap` and `grad`, and never raise for the value of a number.
    """

    # Whether the keys are used: a mission with such a sensor cannot be flown without one.
    random: ClassVar[bool] = True

    @abc.abstractmethod
    def start(self, key: Any, x0: Float[Array, " n"]) -> Any:
        """The memory before the first sample.

        **Arguments:** `key`: a PRNG key of this call's own, None where `random` is False; `x0`
        (n,): the state at which the flight begins.
        """

    @abc.abstractmethod
    def __call__(
        self, key: Any, t: Any, x: Float[Array, " n"], memory: Any
    ) -> tuple[Float[Array, " y"], Any]:
        """The measurement at a sample.

        **Arguments:** `key`: a PRNG key of this sample's own, None where `random` is False; `t` ():
        time of the sample; `x` (n,): the true state there; `memory`: that of the last call.

        **Returns:** the measurement, of any fixed length (that of the state if no estimator comes
        between the sensor and the law), in the dtype of `x`; and the new memory.
        """


class PlainSensor(Plain, Sensor):
    """A function `sensor(key, t, x) -> y` as a Sensor."""

    def start(self, key: Any, x0: Float[Array, " n"]) -> None:
        return None

    def __call__(
        self, key: Any, t: Any, x: Float[Array, " n"], memory: None
    ) -> tuple[Float[Array, " y"], None]:
        return self.function(key, t, x), None
