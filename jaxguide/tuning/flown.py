"""Many dispersed flights as one differentiable function of a mission, in bounded memory."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array

from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, simulate
from jaxguide.montecarlo.dispersions import Distribution
from jaxguide.montecarlo.rollouts import draw, shared, with_deviations
from jaxguide.tuning.measures import endpoint_miss

Measure = Callable[[Mission, Flight], Any]


class Flown(eqx.Module):
    """A function of (mission, keys (cases,)): flies a dispersed case for each key and returns its
    `measure`, with a leading case axis.

    Case k is case k of `jg.sweep` with the same seed. Cases are flown `chunk` at a time, and again
    in the backward pass, so that reverse mode stores the samples of one chunk only.

    **Arguments:**

    - `dispersions`: path (or paths, as a tuple) -> distribution, as for `jg.sweep`.
    - `measure(mission, flight)`: of the dispersed mission and its flight: a scalar, or any pytree
      of arrays. Default `endpoint_miss`.
    - `save`: "ends", or "samples" where the measure looks at histories.
    - `chunk`: cases flown at once.
    """

    dispersions: dict[Any, Distribution]
    measure: Measure = eqx.field(static=True, default=endpoint_miss)
    save: str = eqx.field(static=True, default="ends")
    chunk: int = eqx.field(static=True, default=64)

    def __check_init__(self):
        if self.save not in ("ends", "samples"):
            raise ValueError(f"Flown: save is {self.save!r}; choose 'ends' or 'samples'.")
        if self.chunk < 1:
            raise ValueError(f"Flown: chunk is {self.chunk}; give at least 1.")

    def __call__(self, mission: Mission, keys: Array) -> Any:
        prepared = shared(mission, self.dispersions)

        def fly(key: Array) -> Any:
            k_draw, k_noise = jax.random.split(key)
            deviated = with_deviations(mission, draw(mission, self.dispersions, k_draw))
            return self.measure(deviated, simulate(deviated, k_noise, self.save, prepared))

        again = jax.checkpoint(fly)  # pyright: ignore[reportPrivateImportUsage]
        return jax.lax.map(again, keys, batch_size=self.chunk)
