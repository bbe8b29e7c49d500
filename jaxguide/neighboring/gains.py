"""Gain schedules: du = K(t) dx about an extremal, with an error estimate for every time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.bounds import positive, touches
from jaxguide.host.compilation import kept_hastily
from jaxguide.neighboring.collocated import solve_horizons
from jaxguide.neighboring.costate_gains import gains_at
from jaxguide.neighboring.gain_map import GainMap, HorizonGains, SweptGains
from jaxguide.neighboring.linearization import refuse_integrals, terminal_conditions
from jaxguide.neighboring.segmented import NODES, SEGMENTS, SWEEPS, SweepPair, solve_sweeps
from jaxguide.neighboring.sufficiency import conjugate_ahead
from jaxguide.neighboring.sweep import GROUP
from jaxguide.problem import Problem, count, is_free
from jaxguide.trajectory import Extremal, Point
from jaxguide.types import RESULTS, is_traced, require_x64

METHODS = ("segmented", "least_squares", "square")
_PAPER_NODES = 65  # LGL points of each horizon: N = 64 of the 2002 paper


class GainSchedule(eqx.Module):
    """Gains about `extremal` at `times`, and between: du = K(t) dx, dx = x - x*(t).

    - `K` (T, m, n): gains at `times`. `schedule(t)` (m, n): at any time between;
      `schedule.history(t_k, t)` (m, n): the open-loop du(t) per deviation dx(t_k).
    - `error` (T,): estimated max-norm error of K over its size. `resolved` (T,): error within the
      tolerance, H_uu positive and no conjugate point ahead; `result` (T,) says which failed.
    - `bound_active` (T,): a control, state or path constraint is on a bound, where a linear law
      holds on one side only.
    - `K_parameters` (T, m, p), `K_target` (T, m, q): du per deviation of the chosen parameters and
      of the target of the endpoint constraints (dx held).
    - `dtf_dx` (T, n): change of a free final time per dx; 0 where it is fixed.

    All in user units. **Source:** 2002 paper, eqs (11)-(21), (33)-(49).
    """

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
    between: GainMap

    def __call__(self, t: Any) -> Float[Array, "m n"]:
        """K at `t`, held outside `[times[0], times[-1]]`."""
        t = self.known(jnp.asarray(t, self.times.dtype))
        return self.at(t, self.extremal(t))

    def known(self, t: Array) -> Array:
        """`t`, or the nearest time for which there are gains."""
        return jnp.clip(t, self.times[0], self.times[-1])

    def at(self, t: Array, point: Point) -> Float[Array, "m n"]:
        """K at the scalar `t`, one of the `known` times, where `point` is `extremal(t)`."""
        return self.between.gain(self.extremal, self.times, t, point)

    def history(self, t_k: Any, t: Any) -> Float[Array, "m n"]:
        """du(t) per dx(t_k), t >= t_k: the open-loop control until the next sample (2002 paper,
        eq. (49))."""
        t_k, t = (jnp.asarray(v, self.times.dtype) for v in (t_k, t))
        return self.between.history(self.extremal, self.times, t_k, t)


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
    - `method`: "segmented" (default; adaptive segments swept once), "least_squares" (2002 paper,
      eq. (45), on each remaining horizon) or "square" (as many of these equations as unknowns).
    - `nodes`: Gauss points of each segment (default 8), or LGL points of each horizon (default 65,
      N = 64 of the 2002 paper).
    - `segments`: a multiple of 8. `sweeps`: Picard sweeps.
    - `parameters`: names of scalar fields for which du/dp is wanted.
    - `tolerance`: the relative error up to which a gain counts as resolved.

    **Error:** `.error` estimates it: for "segmented" by a solution of higher order and a bound of
    the rounding errors, for the others by comparison with the segmented gains.

    **Raises:** `ValueError` for bad times or options, naming the value; for integral constraints.

    **Source:** 2002 paper (Yan, Fahroo & Ross), eqs (11)-(21), (33)-(49).
    """
    require_x64("jg.gain_schedule")
    refuse_integrals(extremal, "gain_schedule")
    times = jnp.asarray(times, extremal.t.dtype)
    if extremal.parametric:
        raise ValueError(
            "gain_schedule: the extremal's control is a parameter vector; use "
            "jg.suboptimal_gains, or solve with another method."
        )
    _check_options(method, nodes, segments, sweeps)
    if times.ndim != 1 or times.shape[0] == 0:
        raise ValueError(f"times has shape {times.shape}; give a vector (T,) with T >= 1.")
    if not is_traced((times, extremal.t)):
        known = np.asarray(extremal.t)
        _check_times(np.asarray(times), float(known[0]), float(known[-1]))
    sweep_nodes = NODES if nodes is None or method != "segmented" else nodes
    options = segments, sweep_nodes, sweeps, parameters, tolerance
    schedule = _segmented(extremal, times, *options, _may_touch(extremal.problem))
    if method == "segmented":
        return schedule
    return _collocated(schedule, method, _PAPER_NODES if nodes is None else nodes, tolerance)


def _check_options(method: str, nodes: int | None, segments: int, sweeps: int) -> None:
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; choose one of {', '.join(METHODS)}.")
    if segments < GROUP or segments % GROUP:
        raise ValueError(f"segments is {segments}; give a positive multiple of {GROUP}.")
    if sweeps < 1:
        raise ValueError(f"sweeps is {sweeps}; give at least 1.")
    if nodes is not None and nodes < 3:
        raise ValueError(f"nodes is {nodes}; give at least 3 points.")


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


@kept_hastily
def _segmented(
    extremal: Extremal,
    times: Array,
    segments: int,
    nodes: int,
    sweeps: int,
    parameters: tuple[str, ...],
    tolerance: float,
    bounded: bool,
) -> GainSchedule:
    problem = extremal.problem
    n, p = problem.n, len(parameters)
    free_time = is_free(problem.final_time)
    terminal = terminal_conditions(extremal, parameters)
    pair = solve_sweeps(extremal, terminal, times, segments, nodes, sweeps, parameters)
    both = jax.tree_util.tree_map(lambda a, b: jnp.stack([a, b]), pair.sweep, pair.finer)
    over_times = jax.vmap(lambda s, c, t: gains_at(s, c, t, free_time), in_axes=(None, 0, 0))
    gains = jax.vmap(over_times, in_axes=(0, None, None))(both, pair.at_times, times)
    K, fine = gains.K[0, :, :, :n], gains.K[1, :, :, :n]
    # Thrice the difference, as the finer solution is not exact either: a margin chosen, not tuned.
    error = 3 * _relative(K - fine, fine) + gains.rounding[1]
    error = jnp.where(jnp.isfinite(error), error, jnp.inf)
    resolved, result = _judged(pair, times, error <= tolerance)
    return GainSchedule(
        times=times,
        K=K,
        error=error,
        resolved=resolved,
        result=result,
        bound_active=_bound_active(extremal, times, pair.state, pair.control)
        if bounded
        else jnp.zeros(times.shape, bool),
        K_parameters=gains.K[0, :, :, n : n + p],
        K_target=gains.K[0, :, :, n + p :],
        dtf_dx=gains.time[0, :, :n],
        extremal=extremal,
        between=SweptGains(pair.sweep),
    )


def _relative(
    difference: Float[Array, "time m n"], K: Float[Array, "time m n"]
) -> Float[Array, " time"]:
    """Max-norm of the difference over that of K."""
    return jnp.max(jnp.abs(difference), axis=(1, 2)) / positive(jnp.max(jnp.abs(K), axis=(1, 2)))


def _judged(
    pair: SweepPair, times: Float[Array, " time"], fine_enough: Bool[Array, " time"]
) -> tuple[Bool[Array, " time"], RESULTS]:
    """Whether each gain may be trusted, and the gravest reason why not."""
    end = pair.sweep.breaks[1:]
    convex_ahead = ~jnp.any((end[None, :] > times[:, None]) & ~pair.convex[None, :], axis=1)
    conjugate = conjugate_ahead(pair.sweep, times)

    def reason(fine: Array, conjugate: Array, convex: Array) -> RESULTS:
        result = RESULTS.where(fine, RESULTS.successful, RESULTS.gain_unresolved)
        result = RESULTS.where(conjugate, RESULTS.conjugate_point, result)
        return RESULTS.where(convex, result, RESULTS.not_minimising)

    result = jax.vmap(reason)(fine_enough, conjugate, convex_ahead)
    return fine_enough & convex_ahead & ~conjugate, result


# Distance, as a share of a quantity's size along the extremal, at which it counts as on its bound:
# far above the distance that an interior-point method's last barrier, 1e-10, leaves. Chosen, not
# tuned.
_ON_BOUND = 1e-6


def _may_touch(problem: Problem) -> bool:
    """Whether there is a bound that the extremal could touch; also where that is not to be seen.

    Sizes along the extremal, which tell, would be a fifth of the program.
    """
    bounds = problem.state_bounds, problem.control_bounds
    if is_traced(bounds) or count(problem, "path_constraints"):
        return True
    return not all(np.all(np.isinf(np.asarray(side))) for pair in bounds for side in pair)


def _bound_active(
    extremal: Extremal, times: Array, x: Float[Array, "time n"], u: Float[Array, "time m"]
) -> Bool[Array, " time"]:
    """Where control, state or path constraints sit on a bound: a linear law is one-sided there."""
    problem, size = extremal.problem, extremal.sizes()
    path = jax.vmap(problem.path_constraints)(times, x, u)
    on_any = lambda values, bounds, size: jnp.any(touches(values, bounds, _ON_BOUND * size), axis=1)
    return (
        on_any(u, problem.control_bounds, size.u)
        | on_any(x, problem.state_bounds, size.x)
        | on_any(path, problem.path_bounds, size.path)
    )


@kept_hastily
def _collocated(exact: GainSchedule, method: str, nodes: int, tolerance: float) -> GainSchedule:
    """As `exact`, with the gains of the paper's own equations; their error is the difference."""
    extremal, times = exact.extremal, exact.times
    horizons = solve_horizons(extremal, times, nodes, method == "square")
    K = horizons.controls[:, 0]
    error = _relative(K - exact.K, exact.K)
    error = jnp.where(jnp.isfinite(error), error, jnp.inf) + exact.error
    fine = error <= tolerance
    result = jax.vmap(
        lambda ok, previous: RESULTS.where(
            ok | (previous != RESULTS.successful), previous, RESULTS.gain_unresolved
        )
    )(fine, exact.result)
    return GainSchedule(
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
        between=HorizonGains(horizons),
    )
