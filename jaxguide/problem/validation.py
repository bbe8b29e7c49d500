"""Badly stated problems are refused with the field, its value and the remedy. Host only."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.host.compilation import kept_quickly
from jaxguide.problem.boundary import initial_entries, initial_values, initially_free, start_control
from jaxguide.problem.parameters import with_parameters
from jaxguide.problem.statement import Problem, is_free, start_value, with_typed_leaves
from jaxguide.types import is_traced

# How far an initial state may lie outside the state bounds, relative to 1 + |x0|: the rounding of
# whatever computed it. The 1 is in the user's unit, as bounds of (0, inf) tell no size; where that
# lets too much pass, the method finds the start infeasible. Chosen, not tuned.
_ROUNDING = 1e-9


@kept_quickly
def _start(problem: Problem) -> tuple[Any, ...]:
    """Times, state, control and rate from which a search would start."""
    dtype = jnp.result_type(float)
    times = (problem.initial_time, problem.final_time)
    t0, tf = (jnp.asarray(start_value(t), dtype) for t in times)
    x0, u0 = jnp.asarray(initial_values(problem, dtype)), jnp.asarray(start_control(problem, dtype))
    return t0, tf, x0, u0, with_parameters(problem, None).dynamics(t0, x0, u0)


def _shape(stated: Problem, name: str, wanted: tuple[int, ...] | None, *args: Any) -> tuple:
    """The shape that the function `name` of a Problem with numbers for its parameters returns,
    refused unless `wanted` (None: a vector)."""
    try:
        out = jax.eval_shape(getattr(stated, name), *args)
    except Exception as e:
        kind, unnamed = type(stated).__name__, ""
        if not stated.m:
            unnamed = (
                f" {kind}.control_names is (), so there is no control; if there is one, name it "
                "there, in a tuple of strings."
            )
        raise ValueError(
            f"{kind}.{name} could not be evaluated with a state of {stated.n} and a control of "
            f"{stated.m} components: {e}\nIndex and stack by these sizes, with jax.numpy.{unnamed}"
        ) from e
    shape = getattr(out, "shape", None)
    if wanted is not None and shape != wanted:
        entry = "control" if name == "optimal_control" else "state"
        raise ValueError(
            f"{type(stated).__name__}.{name} returned shape {shape}, expected {wanted}. "
            + ("Return a scalar." if wanted == () else f"Stack one entry per {entry}.")
        )
    if wanted is None and (shape is None or len(shape) != 1):
        raise ValueError(
            f"{type(stated).__name__}.{name} returned shape {shape}; return a vector (jnp.stack)."
        )
    return shape  # pyright: ignore[reportReturnType]


def _check_names(problem: Problem, name: str) -> None:
    names = getattr(problem, name)
    some = bool(names) or name == "control_names"
    if isinstance(names, str) or not isinstance(names, tuple) or not some:
        raise ValueError(
            f"{type(problem).__name__}.{name} is {names!r}; give a "
            f"{'' if name == 'control_names' else 'non-empty '}tuple of strings, such as "
            f"{name} = ('x',)."
        )
    if len(set(names)) != len(names):
        raise ValueError(
            f"{type(problem).__name__}.{name} repeats a name: {names}; rename one of them."
        )


def _check_bounds(problem: Problem, name: str, size: int) -> None:
    bounds = getattr(problem, name)
    if not isinstance(bounds, tuple) or len(bounds) != 2:
        raise ValueError(f"{type(problem).__name__}.{name} is {bounds!r}; give (lower, upper).")
    try:
        lower, upper = (np.broadcast_to(np.asarray(b, float), (size,)) for b in bounds)
    except ValueError as e:
        raise ValueError(
            f"{type(problem).__name__}.{name} = {bounds} does not broadcast to {size} components; "
            "give a number for all of them or one for each."
        ) from e
    bad = ~(lower <= upper)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"{type(problem).__name__}.{name}: component {i} has lower {lower[i]} above upper "
            f"{upper[i]} (or NaN); exchange or correct them."
        )


def _check_start(problem: Problem, x0: Any) -> None:
    """Refuses an initial state outside the state bounds, and a free one whose range is."""
    lower, upper = (
        np.broadcast_to(np.asarray(b, float), (problem.n,)) for b in problem.state_bounds
    )
    for i, (name, entry) in enumerate(
        zip(problem.state_names, initial_entries(problem), strict=True)
    ):
        free = is_free(entry)
        lo, hi = (float(entry.lo), float(entry.hi)) if free else (float(x0[i]), float(x0[i]))
        slack = _ROUNDING * (1 + abs(x0[i]))
        if hi < lower[i] - slack or lo > upper[i] + slack:
            given = f"between {lo} and {hi}" if free else f"{lo}"
            raise ValueError(
                f"{type(problem).__name__}.initial_state: {name} is {given}, outside state_bounds "
                f"[{lower[i]}, {upper[i]}]; change one of the two."
            )


def check_initial_state(problem: Problem) -> None:
    """Refuses an `initial_state` that has not one entry for each state.

    **Raises:** `ValueError`.
    """
    kind, n = type(problem).__name__, problem.n
    entries = problem.initial_state
    if entries is not None and not is_free(entries):
        if not isinstance(entries, (tuple, list)) and jnp.ndim(entries) != 1:
            raise ValueError(
                f"{kind}.initial_state is {entries!r}; give one entry for each of the {n} states "
                f"{problem.state_names}."
            )
        size = len(entries) if isinstance(entries, (tuple, list)) else jnp.shape(entries)[0]
        if size != n:
            raise ValueError(
                f"{kind}.initial_state has {size} entries for {n} states {problem.state_names}; "
                "give a number or jg.Free() for each."
            )


def validate(problem: Problem) -> None:
    """Refuses a badly stated problem, naming the field, its value and the remedy.

    Shapes are always checked; values only when they are concrete (not under a trace).

    **Raises:** `ValueError`.
    """
    if not isinstance(problem, Problem):
        raise ValueError(
            f"expected an instance of a jaxguide.Problem, got {problem!r}; "
            "did you pass the class and not an instance?"
        )
    _check_names(problem, "state_names")
    _check_names(problem, "control_names")
    problem.check_statement()
    check_initial_state(problem)
    sizes = _check_shapes(problem)
    if is_traced(problem):
        return
    for name, size in sizes.items():
        _check_bounds(problem, name, size)
    t0, tf, x0, u0, rate = jax.device_get(_start(with_typed_leaves(problem)))
    _check_initial_values(problem, x0)
    _check_horizon(problem, float(t0), float(tf))
    if not np.all(np.isfinite(rate)) and not any(initially_free(problem)):
        i = int(np.argmin(np.isfinite(rate)))
        raise ValueError(
            f"{type(problem).__name__}.dynamics: d({problem.state_names[i]})/dt is {rate[i]} at "
            f"the start t={float(t0)}, x={x0}, u={u0}; give state bounds or a guess that keep "
            "clear of the singularity, or correct the equation."
        )


def _check_shapes(problem: Problem) -> dict[str, int]:
    """Refuses functions of the wrong shape; the sizes that bounds must have, by their names."""
    n, m, dtype = problem.n, problem.m, jnp.result_type(float)
    t = jax.ShapeDtypeStruct((), dtype)
    x, u = jax.ShapeDtypeStruct((n,), dtype), jax.ShapeDtypeStruct((m,), dtype)
    stated = with_parameters(problem, None)
    _shape(stated, "dynamics", (n,), t, x, u)
    _shape(stated, "running_cost", (), t, x, u)
    _shape(stated, "endpoint_cost", (), x, x, t, t)
    sizes = {
        "state_bounds": n,
        "control_bounds": m,
        "endpoint_bounds": _shape(stated, "endpoint_constraints", None, x, x, t, t)[0],
        "path_bounds": _shape(stated, "path_constraints", None, t, x, u)[0],
        "integral_bounds": _shape(stated, "integrands", None, t, x, u)[0],
    }
    if problem.has_closed_form:
        _shape(stated, "optimal_control", (m,), t, x, x)
    return sizes


def _check_initial_values(problem: Problem, x0: np.ndarray) -> None:
    """Refuses an initial state that is not finite, and one outside the state bounds."""
    free = initially_free(problem)
    for i, name in enumerate(problem.state_names):
        if not np.isfinite(x0[i]):
            raise ValueError(
                f"{type(problem).__name__}.initial_state: {name} is {x0[i]}; give a finite number"
                + (" as the guess of its jg.Free." if free[i] else " or jg.Free().")
            )
    _check_start(problem, x0)


def _check_horizon(problem: Problem, t0: float, tf: float) -> None:
    """Refuses times that are no numbers, and a horizon that cannot have a positive length."""
    kind = type(problem).__name__
    free_start, free_end = is_free(problem.initial_time), is_free(problem.final_time)
    if math.isnan(t0) or math.isnan(tf) or math.isinf(t0):
        raise ValueError(f"{kind}: initial_time is {t0} and final_time is {tf}; give numbers.")
    if math.isinf(tf) and free_start:
        raise ValueError(
            f"{kind}: final_time is infinite and initial_time is {problem.initial_time}; give a "
            "number for one of the two."
        )
    if not tf > t0 and not free_end and not free_start:
        raise ValueError(
            f"{kind}: final_time {tf} is not after initial_time {t0}; the horizon must be positive."
        )
    latest = problem.final_time.hi if free_end else tf
    earliest = problem.initial_time.lo if free_start else t0
    if not float(latest) > float(earliest):
        raise ValueError(
            f"{kind}: final_time is at most {float(latest)} and initial_time at least "
            f"{float(earliest)}; the horizon must be positive."
        )
