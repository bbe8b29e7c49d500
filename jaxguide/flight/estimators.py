"""Estimators: the state that the law is given, from measurements and from the controls flown."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from jaxguide.laws.law import Command
from jaxguide.laws.plain import Plain, fulfilled


class Estimate(NamedTuple):
    """An estimate of the state: `state` (n,), and its `covariance` (n, n) if the estimator has one,
    in the units of the state and their products."""

    state: Float[Array, " n"]
    covariance: Float[Array, "n n"] | None = None


class Estimator(eqx.Module):
    """Abstract: estimates the state at each sample. Without memory, a function
    `estimator(t, y) -> x` does as well.

    `update` takes in the measurement of each sample, the first one included; `predict` takes the
    memory from one sample to the next. `memory` is a pytree (an estimate and its covariance, say)
    that keeps its structure, shapes and dtypes. The methods must work under `jit`, `vmap` and
    `grad`, and never raise for the value of a number.
    """

    @abc.abstractmethod
    def start(self, x0: Float[Array, " n"]) -> Any:
        """The memory before the first sample.

        **Arguments:** `x0` (n,): the state at which the flight truly begins, dispersion included.
        An estimator that must not know it has a field for its own first guess.
        """

    @abc.abstractmethod
    def predict(self, memory: Any, flown: Command, t: Any, t_next: Any) -> Any:
        """The memory at the next sample, before its measurement.

        **Arguments:** `memory`: as `update` returned it at `t`; `flown(s)` is the control
        (m,) that was flown at any time s from `t` to `t_next`, after hold and actuator; `t`,
        `t_next` (): this sample's time and the next one's, or the end; they may be equal.
        """

    @abc.abstractmethod
    def update(self, memory: Any, t: Any, y: Float[Array, " y"]) -> tuple[Estimate, Any]:
        """The estimate at a sample.

        **Arguments:** `memory`: at `t`, before the measurement; `t` (): time of the sample; `y`:
        the measurement, as the sensor gives it.

        **Returns:** the Estimate, whose state goes to the law, and the new memory.
        """


class PlainEstimator(Plain, Estimator):
    """A function `estimator(t, y) -> x` as an Estimator."""

    def start(self, x0: Float[Array, " n"]) -> None:
        return None

    def predict(self, memory: None, flown: Command, t: Any, t_next: Any) -> None:
        return None

    def update(self, memory: None, t: Any, y: Float[Array, " y"]) -> tuple[Estimate, None]:
        return Estimate(self.function(t, y)), None


def as_estimator(value: Any) -> Any:
    """`value` as an Estimator: see `fulfilled`.

    **Raises:** `ValueError` for the form of earlier versions, `start` and `(t, y, memory)`, too.
    """
    if not isinstance(value, (Estimator, type)) and hasattr(value, "start"):
        raise ValueError(
            f"Mission: estimator is {value!r}, which has memory (`start`) but is no jg.Estimator. "
            "Derive its class from jg.Estimator: `update(memory, t, y) -> (jg.Estimate, memory)` "
            "takes the place of the call, and `predict(memory, flown, t, t_next) -> memory` takes "
            "the memory to the next sample (return it as it is to leave the flown control out)."
        )
    return fulfilled(value, Estimator, PlainEstimator, "estimator", ("t", "y"))
