"""The horizon of a mission and its number of samples."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxguide.laws.law import Law
from jaxguide.laws.plain import fulfilled
from jaxguide.problem import Problem, is_free
from jaxguide.types import is_traced

# Samples beyond those that fill the horizon, in which a law that decides the end closes in on it by
# shorter and shorter ones (by experiment on the thesis's flights, which need two to four).
_LAST_STEPS = 8
# A sample interval longer than the horizon by less than the fraction `_ROUNDING` is the horizon,
# and a last sample shorter than `_NO_SAMPLE` of an interval is none: both far above the rounding of
# times. Chosen, not tuned.
_ROUNDING, _NO_SAMPLE = 1e-12, 1e-9


def flight_horizon(plant: Problem, law: Any, initial_time: Any, final_time: Any) -> tuple[Any, Any]:
    """First and last time of a mission: those given, or else the plant's, or else the law's latest
    end if it decides the end.

    **Raises:** `ValueError` for a time that is free, or known to nobody, and for no Law.
    """
    fulfilled(law, Law, None, "law")
    initial_time = plant.initial_time if initial_time is None else initial_time
    if final_time is None:
        final_time = law.latest_end(initial_time) if law.decides_end else plant.final_time
    if final_time is None:
        raise ValueError(
            f"Mission: {type(law).__name__} decides the end of its flight, but has no latest_end; "
            "pass final_time, the latest."
        )
    for name, value in (("initial_time", initial_time), ("final_time", final_time)):
        if is_free(value):
            raise ValueError(
                f"Mission: the plant's {name} is free; pass {name}=extremal.{name}, say."
            )
    return initial_time, final_time


def sample_count(
    law: Law, interval: Any, ends: tuple[Any, Any], dtype: Any, max_samples: int | None
) -> int:
    """The static number of samples: `max_samples`, or as many as the horizon `ends` holds.

    **Raises:** `ValueError` for an interval or a number of samples that does not fit.
    """
    # Asked of the arguments as given: under a trace, even a number becomes a tracer as an array.
    traced = is_traced((interval, ends))
    if jnp.ndim(interval):
        max_samples = _one_length_each(law, interval, None if traced else ends, dtype, max_samples)
    elif not traced:
        number = lambda a: float(np.asarray(a))
        count = _samples_within(number(interval), number(ends[0]), number(ends[1]))
        count += _LAST_STEPS if law.decides_end else 0
        if max_samples is not None and max_samples < count:
            raise ValueError(
                f"Mission: max_samples is {max_samples}, but the horizon holds {count} "
                "samples; give at least as many, or leave it out."
            )
        max_samples = count if max_samples is None else max_samples
    if max_samples is None:
        raise ValueError(
            "Mission: max_samples must be given when the sample interval or the horizon is "
            "traced (it fixes the shape of a flight)."
        )
    if max_samples < 1:
        raise ValueError(f"Mission: max_samples is {max_samples}; give at least 1.")
    return max_samples


def _one_length_each(
    law: Law, lengths: Any, ends: tuple[Any, Any] | None, dtype: Any, max_samples: int | None
) -> int:
    """The number of samples whose lengths are given one by one; `ends`: None under a trace."""
    shape = jnp.shape(lengths)
    if len(shape) != 1 or not shape[0] or max_samples not in (None, shape[0]):
        raise ValueError(
            f"Mission: sample_interval has shape {shape} and max_samples is {max_samples}; "
            "give one number, or a vector of the lengths of all samples and no max_samples."
        )
    if law.decides_end:
        raise ValueError(
            f"Mission: {type(law).__name__} decides the end of its flight, so the lengths of its "
            "samples cannot be given ahead; give one sample_interval."
        )
    if ends is not None:
        host, t0, tf = (np.asarray(a).astype(dtype) for a in (lengths, *ends))
        span = float(tf - t0)
        if not np.all(np.isfinite(host)) or np.any(host < 0):
            k = int(np.argmax(~np.isfinite(host) | (host < 0)))
            raise ValueError(
                f"Mission: sample_interval[{k}] is {host[k]}; give finite lengths, none below 0."
            )
        slack = 4 * host.size * float(jnp.finfo(dtype).eps)  # a rounding each, and some more
        if abs(host.sum() - span) > slack * abs(span):
            raise ValueError(
                f"Mission: sample_interval adds up to {host.sum()}, but the horizon is {span} "
                "long; scale the lengths to it."
            )
    return shape[0]


def _samples_within(interval: float, t0: float, tf: float) -> int:
    """Samples of this interval that the horizon holds, the last perhaps a shorter one."""
    if not (math.isfinite(t0) and math.isfinite(tf)) or not tf > t0:
        raise ValueError(
            f"Mission: the horizon [{t0}, {tf}] must be finite and of positive length."
        )
    if not interval > 0 or not math.isfinite(interval):
        raise ValueError(f"Mission: sample_interval is {interval}; give a positive number.")
    if interval > (tf - t0) * (1 + _ROUNDING):
        raise ValueError(
            f"Mission: sample_interval {interval} is longer than the horizon {tf - t0}; give at "
            "most the horizon (one sample)."
        )
    return math.ceil((tf - t0) / interval - _NO_SAMPLE)
