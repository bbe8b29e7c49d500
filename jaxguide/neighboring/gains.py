"""Gain schedules: du = K(t) dx about an extremal, with an error estimate for every time."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.bounds import touches
from jaxguide.linalg import solve
from jaxguide.neighboring.collocated import solve_horizons
from jaxguide.neighboring.linearization import refuse_integrals, terminal_conditions
from jaxguide.neighboring.segmented import (
    NODES,
    SEGMENTS,
    SWEEPS,
    Sweep,
    canonical_at,
    gains_at,
    propagate,
    solve_sweeps,
)
from jaxguide.neighboring.sufficiency import conjugate_ahead
from jaxguide.problem import is_free
from jaxguide.spectral import interpolate
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS, is_traced, require_x64

METHODS = ("segmented", "least_squares", "square")


class GainSchedule(eqx.Module):
    """Gains about `extremal` at `times`, and between.

    `K` (T, m, n): du = K dx at `times`. `schedule(t)` (m, n) anywhere in between;
    `schedule.history(t_k, t)` (m, n): the open-loop du(t) per deviation dx(t_k), eqs (46)-(49).
    `error` (T,): estimated max-norm error of the row over its size; `resolved` (T,): error below
    tolerance, H_uu positive and no conjugate point ahead; `result` (T,) says which failed.
    `K_parameters` (T, m, p), `K_target` (T, m, q): du per deviation of parameters and of the
    target of the endpoint constraints (dx held); `dtf_dx` (T, n): change of a free final time.
    """

    times: eqx.AbstractVar[Float[Array, " time"]]
    K: eqx.AbstractVar[Float[Array, "time m n"]]
    error: eqx.AbstractVar[Float[Array, " time"]]
    resolved: eqx.AbstractVar[Bool[Array, " time"]]
    result: eqx.AbstractVar[RESULTS]
    bound_active: eqx.AbstractVar[Bool[Array, " time"]]
    K_parameters: eqx.AbstractVar[Float[Array, "time m p"]]
    K_target: eqx.AbstractVar[Float[Array, "time m q"]]
    dtf_dx: eqx.AbstractVar[Float[Array, "time n"]]
    extremal: eqx.AbstractVar[Extremal]

    @abc.abstractmethod
    def __call__(self, t: Any) -> Float[Array, "m n"]:
        """K at `t`, held outside `[times[0], times[-1]]`."""

    @abc.abstractmethod
    def history(self, t_k: Any, t: Any) -> Float[Array, "m n"]:
        """du(t) per dx(t_k), t >= t_k: the open-loop control until the next sample."""


class SegmentedSchedule(GainSchedule):
    """From the backward sweep: exact between `times` too."""

    times: Float[Array, " time"]
    K: Float[Array, "time m n"]
    error: Float[Array, " time"]
    resolved: Bool[Array, " time"]
    result: RESULTS
    bound_active: Bool[Array, " time"]
    K_parameters: Float[Array, "time m p"]
    K_target: Float[Array, "time m q"]
    dtf_dx: Float[Array, "time n"]
    extremal: Extremal
    sweep: Sweep

    def __call__(self, t: Any) -> Float[Array, "m n"]:
        t = jnp.clip(jnp.asarray(t, self.times.dtype), self.times[0], self.times[-1])
        c, _ = canonical_at(self.extremal.problem, t, self.extremal(t), ())
        return gains_at(self.sweep, c, t, False).K[:, : self._n]

    def history(self, t_k: Any, t: Any) -> Float[Array, "m n"]:
        t_k, t = (jnp.asarray(v, self.times.dtype) for v in (t_k, t))
        c, _ = canonical_at(self.extremal.problem, t, self.extremal(t), ())
        return c.U @ propagate(self.sweep, t_k, t)

    @property
    def _n(self) -> int:
        return self.K.shape[2]


class CollocatedSchedule(GainSchedule):
    """From the paper's V on each remaining horizon: eq. (45) and its square variant."""

    times: Float[Array, " time"]
    K: Float[Array, "time m n"]
    error: Float[Array, " time"]
    resolved: Bool[Array, " time"]
    result: RESULTS
    bound_active: Bool[Array, " time"]
    K_parameters: Float[Array, "time m p"]
    K_target: Float[Array, "time m q"]
    dtf_dx: Float[Array, "time n"]
    extremal: Extremal
    reference_nodes: Float[Array, " node"]
    state_maps: Float[Array, "time node n n"]  # W1, eq. (46)
    control_maps: Float[Array, "time node m n"]  # eq. (49)

    def _at(self, k: Array, t: Array) -> tuple[Array, Array]:
        a, b = self.times[k], self.extremal.t[-1]
        tau = 2 * (t - a) / (b - a) - 1
        x = interpolate(self.reference_nodes, self.state_maps[k], tau)
        return x, interpolate(self.reference_nodes, self.control_maps[k], tau)

    def _sample(self, t: Array) -> Array:
        # A time meant to be a sample may differ from it by rounding.
        slack = 1e-12 * (self.times[-1] - self.times[0] + jnp.abs(t))
        after = jnp.searchsorted(self.times, t + slack, side="right", method="compare_all")
        return jnp.clip(after - 1, 0, self.times.shape[0] - 1)

    def __call__(self, t: Any) -> Float[Array, "m n"]:
        # du(t) = C(t) dx(t_k) and dx(t) = X(t) dx(t_k) on the horizon begun at t_k <= t.
        t = jnp.clip(jnp.asarray(t, self.times.dtype), self.times[0], self.times[-1])
        x, u = self._at(self._sample(t), t)
        return solve(x.T, u.T).T

    def history(self, t_k: Any, t: Any) -> Float[Array, "m n"]:
        t_k, t = (jnp.asarray(v, self.times.dtype) for v in (t_k, t))
        return self._at(self._sample(t_k), t)[1]


def gain_schedule(
    extremal: Extremal,
    times: Any,
    method: str = "segmented",
    nodes: int | None = None,
    segments: int = SEGMENTS,
    sweeps: int = SWEEPS,
    parameters: tuple[str, ...] = (),
    tolerance: float = 1e-6,
) -> GainSchedule:
    """Neighbouring-optimal gains of `extremal` at `times`.

    **Arguments:**

    - `times` (T,): ascending, in [t0, tf).
    - `method`: "segmented" (default; adaptive segments swept once), "least_squares" (the paper's
      eq. 45 on each remaining horizon) or "square" (the same equations with as many as unknowns).
    - `nodes`: points: Gauss points a segment (default 8), or LGL points of each horizon (default
      65, the paper's N = 64).
    - `segments`: a multiple of 8. `sweeps`: Picard sweeps.
    - `parameters`: names of scalar fields for which du/dp is wanted.
    - `tolerance`: the relative error up to which a gain counts as resolved.

    **Error:** `.error` estimates it: for "segmented" by a solution of higher order plus what
    rounding can do, for the others by comparison with the segmented gains.

    **Raises:** `ValueError` for bad times or options, naming the value; for integral constraints.

    **Source:** Yan, Fahroo & Ross (2002), eqs (11)-(21), (33)-(49).
    """
    require_x64("jg.gain_schedule")
    refuse_integrals(extremal, "gain_schedule")
    times = jnp.asarray(times, extremal.t.dtype)
    if extremal.parametric:
        raise ValueError(
            "gain_schedule: the extremal's control is a parameter vector; use "
            "jg.suboptimal_gains, or solve with another method."
        )
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; choose one of {', '.join(METHODS)}.")
    if segments < 8 or segments % 8:
        raise ValueError(f"segments is {segments}; give a positive multiple of 8.")
    if sweeps < 1:
        raise ValueError(f"sweeps is {sweeps}; give at least 1.")
    if times.ndim != 1 or times.shape[0] == 0:
        raise ValueError(f"times has shape {times.shape}; give a vector (T,) with T >= 1.")
    if not is_traced((times, extremal.t)):
        _check_times(np.asarray(times), float(extremal.t[0]), float(extremal.t[-1]))
    if nodes is not None and nodes < 3:
        raise ValueError(f"nodes is {nodes}; give at least 3 points.")
    sweep_nodes = NODES if nodes is None or method != "segmented" else nodes
    schedule = _segmented(extremal, times, segments, sweep_nodes, sweeps, parameters, tolerance)
    if method == "segmented":
        return schedule
    return _collocated(schedule, method, 65 if nodes is None else nodes, tolerance)


def _check_times(times: np.ndarray, t0: float, tf: float) -> None:
    if not np.all(np.isfinite(times)):
        raise ValueError(f"times holds {times[~np.isfinite(times)][0]}; give finite times.")
    if np.any(np.diff(times) <= 0):
        i = int(np.argmax(np.diff(times) <= 0))
        raise ValueError(
            f"times must ascend: times[{i}] = {times[i]}, times[{i + 1}] = {times[i + 1]}."
        )
    if times[0] < t0 or times[-1] >= tf:
        raise ValueError(
            f"times span [{times[0]}, {times[-1]}], outside [{t0}, {tf}): at the final time a hard "
            "constraint makes the gain infinite; stop short of it."
        )


@eqx.filter_jit
def _segmented(
    extremal: Extremal,
    times: Array,
    segments: int,
    nodes: int,
    sweeps: int,
    parameters: tuple[str, ...],
    tolerance: float,
) -> SegmentedSchedule:
    problem = extremal.problem
    n, p = problem.n, len(parameters)
    free_time = is_free(problem.final_time)
    terminal = terminal_conditions(extremal, parameters)
    pair = solve_sweeps(extremal, terminal, times, segments, nodes, sweeps, parameters)
    sweep, convex = pair.sweep, pair.convex
    both = jax.tree_util.tree_map(lambda a, b: jnp.stack([a, b]), pair.sweep, pair.finer)
    over_times = jax.vmap(lambda s, c, t: gains_at(s, c, t, free_time), in_axes=(None, 0, 0))
    gains = jax.vmap(over_times, in_axes=(0, None, None))(both, pair.at_times, times)
    K, fine = gains.K[0, :, :, :n], gains.K[1, :, :, :n]
    size = jnp.max(jnp.abs(fine), axis=(1, 2))
    difference = jnp.max(jnp.abs(K - fine), axis=(1, 2)) / jnp.where(size > 0, size, 1.0)
    # Thrice the difference: the finer solution is not exact either.
    error = 3 * difference + gains.rounding[1]
    error = jnp.where(jnp.isfinite(error), error, jnp.inf)
    end = sweep.breaks[1:]
    convex_ahead = ~jnp.any((end[None, :] > times[:, None]) & ~convex[None, :], axis=1)
    conjugate = conjugate_ahead(sweep, times)
    fine_enough = error <= tolerance
    success = jax.vmap(lambda ok: RESULTS.where(ok, RESULTS.successful, RESULTS.gain_unresolved))
    merge = jax.vmap(RESULTS.where)
    spread = lambda item: jax.vmap(lambda _: RESULTS.where(jnp.array(True), item, item))(times)
    result = success(fine_enough)
    result = merge(conjugate, spread(RESULTS.conjugate_point), result)
    result = merge(~convex_ahead, spread(RESULTS.not_minimising), result)
    return SegmentedSchedule(
        times=times,
        K=K,
        error=error,
        resolved=fine_enough & convex_ahead & ~conjugate,
        result=result,
        bound_active=_bound_active(extremal, times, pair.control),
        K_parameters=gains.K[0, :, :, n : n + p],
        K_target=gains.K[0, :, :, n + p :],
        dtf_dx=gains.time[0, :, :n],
        extremal=extremal,
        sweep=sweep,
    )


# Part of a quantity's size along the extremal: how near a bound counts as on it. What a barrier of
# 1e-9 leaves between an active bound and the solution is far below.
_ON_BOUND = 1e-6


def _bound_active(
    extremal: Extremal, times: Array, u: Float[Array, "time m"]
) -> Bool[Array, " time"]:
    """Where control, state or path constraints sit on a bound: a linear law is one-sided there."""
    problem, size = extremal.problem, extremal.sizes()
    x = jax.vmap(extremal.point)(times).x
    path = jax.vmap(problem.path_constraints)(times, x, u)
    on_any = lambda values, bounds, size: jnp.any(touches(values, bounds, _ON_BOUND * size), axis=1)
    return (
        on_any(u, problem.control_bounds, size.u)
        | on_any(x, problem.state_bounds, size.x)
        | on_any(path, problem.path_bounds, size.path)
    )


@eqx.filter_jit
def _collocated(
    exact: SegmentedSchedule, method: str, nodes: int, tolerance: float
) -> CollocatedSchedule:
    extremal, times = exact.extremal, exact.times
    horizons = solve_horizons(extremal, times, nodes, method == "square")
    K = horizons.controls[:, 0]
    size = jnp.max(jnp.abs(exact.K), axis=(1, 2))
    error = jnp.max(jnp.abs(K - exact.K), axis=(1, 2)) / jnp.where(size > 0, size, 1.0)
    error = jnp.where(jnp.isfinite(error), error, jnp.inf) + exact.error
    fine = error <= tolerance
    result = jax.vmap(
        lambda ok, previous: RESULTS.where(
            ok | (previous != RESULTS.successful), previous, RESULTS.gain_unresolved
        )
    )(fine, exact.result)
    return CollocatedSchedule(
        times=times,
        K=K,
        error=error,
        resolved=exact.resolved & fine,
        result=result,
        bound_active=exact.bound_active,
        K_parameters=exact.K_parameters,
        K_target=exact.K_target,
        dtf_dx=exact.dtf_dx,
        extremal=extremal,
        reference_nodes=horizons.nodes,
        state_maps=horizons.states,
        control_maps=horizons.controls,
    )
