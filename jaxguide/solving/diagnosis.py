"""Why no extremal was found: the worst constraint by name, node, time and value, in the user's
units. Host only."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.bounds import bounds_of, overstep
from jaxguide.certificate import Certified
from jaxguide.nominal.defects import defects
from jaxguide.problem import initially_free
from jaxguide.problem.points import end_slopes, integrand_slopes, rates, slopes
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS

_NEGLIGIBLE = 1e-8  # of a constraint's size: no miss


def why(extremal: Extremal) -> str:
    """One sentence or two: the reason, the worst miss, what to try."""
    extremal = jax.device_get(extremal)
    with np.errstate(all="ignore"):
        return _why(extremal)


def _why(extremal: Extremal) -> str:
    problem = extremal.problem
    sentences = [f"{type(problem).__name__}: {RESULTS[extremal.result]}"]
    undefined = _undefined(extremal)
    if undefined:
        sentences.append(undefined)
    else:
        misses = sorted(_misses(extremal), key=lambda m: -m[0])
        misses = [text for size, text in misses[:2] if size > _NEGLIGIBLE]
        sentences += [_wall(extremal), *misses] if misses else []
    sentences = [sentence for sentence in sentences if sentence]
    sentences.append(f"Largest scaled residual {float(extremal.residual):.2e}.")
    return " ".join(sentences)


def shortfall(extremal: Certified) -> str:
    """How far a solution is from what was asked: the worst row of its certificate, and the
    remedy."""
    rows = extremal.certificate.rows()
    size = lambda row: np.nan_to_num(row["value"], nan=np.inf) / row["tolerance"]
    worst = max((row for row in rows if row["tolerance"] > 0), key=size)
    where = f" of {worst['where']}" if worst["where"] else ""
    return (
        f"{type(extremal.problem).__name__}: {RESULTS[extremal.result]} Worst in its certificate: "
        f"{worst['check']}{where}, {worst['value']:.2e} at t = {worst['time']:.6g}, where "
        f"{worst['tolerance']:.1e} passes."
    )


def _undefined(extremal: Extremal) -> str:
    """Where the problem's functions, or their derivatives, leave finite numbers."""
    problem, t, x, u = extremal.problem, extremal.t, extremal.x, extremal.u
    t: Any = np.where(np.isfinite(t), t, 0.0)
    for name, values in (("state", x), ("control", u)):
        if not np.all(np.isfinite(values)):
            return f"The last iterate's {name} left finite numbers."
    at, (gain, gain_by) = slopes(extremal.stated, t, x, u), integrand_slopes(problem, t, x, u)
    of_points = (
        ("dynamics", at.f, at.f_by),
        ("running_cost", at.cost, at.cost_by),
        ("path_constraints", at.path, at.path_by),
        ("integrands", gain, gain_by),
    )
    for name, value, by in of_points:
        for what, array in ((name, value), (f"a derivative of {name}", by)):
            found = _first_undefined(array.reshape(len(t), -1) if array.size else array[:, :0])
            if found:
                k, i, bad = found
                if what == "dynamics":
                    what = f"dynamics: d({problem.state_names[i]})/dt"
                return (
                    f"{what} is {bad} at node {k} (t = {float(t[k]):.6g}, x = {x[k]}, "
                    f"u = {u[k]}); keep clear of the singularity by state bounds or a "
                    "guess, or mend the equation."
                )
    ends = end_slopes(extremal.stated, x[0], x[-1], t[0], t[-1])
    for name, rows in (("endpoint_cost", slice(0, 1)), ("endpoint_constraints", slice(1, None))):
        parts = ((name, ends.value[rows]), (f"a derivative of {name}", ends.by[rows]))
        for what, array in parts:
            found = _first_undefined(array.reshape(1, -1) if array.size else np.zeros((1, 0)))
            if found:
                return (
                    f"{what} is {found[2]} at x0 = {x[0]}, xf = {x[-1]}, "
                    f"t0 = {float(t[0]):.6g}, tf = {float(t[-1]):.6g}; keep clear of the "
                    "singularity by bounds or a guess, or mend the equation."
                )
    return ""


def _first_undefined(values: Any) -> tuple[int, int, float] | None:
    """Row, column and value of the first entry that is no finite number."""
    values = np.asarray(values)
    bad = np.argwhere(~np.isfinite(values))
    return (int(bad[0, 0]), int(bad[0, 1]), float(values[tuple(bad[0])])) if len(bad) else None


def _misses(extremal: Extremal) -> list[tuple[float, str]]:
    """The worst of each kind of constraint: its error relative to its size, and a sentence."""
    problem, t, size = extremal.problem, np.asarray(extremal.t), _sizes(extremal)
    out = [_worst_defect(extremal, size)]
    e: Any = end_slopes(extremal.stated, extremal.x[0], extremal.x[-1], t[0], t[-1]).value[1:]
    if len(e):
        lo, hi = _sides(problem.endpoint_bounds, len(e))
        miss = np.asarray(overstep(e, problem.endpoint_bounds))
        i = int(np.argmax(miss / size.end))
        out.append(
            (
                float((miss / size.end)[i]),
                f"Endpoint constraint {i} misses its bounds by {miss[i]:.3g} (value "
                f"{float(e[i]):.6g}, bounds [{lo[i]:g}, {hi[i]:g}]); if it contradicts another or "
                "lies out of reach, relax it.",
            )
        )
    h: Any = rates(extremal.stated, extremal.t, extremal.x, extremal.u)[2]
    paths = [str(i) for i in range(h.shape[1])]
    kinds: Any = (
        ("State", problem.state_names, extremal.x, problem.state_bounds, size.x),
        ("Control", problem.control_names, extremal.u, problem.control_bounds, size.u),
        ("Path constraint", paths, h, problem.path_bounds, size.path),
    )
    for what, names, values, bounds, of in kinds:
        if not values.shape[1]:
            continue
        lo, hi = _sides(bounds, values.shape[1])
        miss = np.asarray(overstep(values, bounds))
        relative = miss / of
        k, i = np.unravel_index(int(np.argmax(relative)), relative.shape)
        out.append(
            (
                float(relative[k, i]),
                f"{what} {names[i]} is {float(values[k, i]):.6g} at node {k} (t = {t[k]:.6g}), "
                f"outside [{lo[i]:g}, {hi[i]:g}] by {miss[k, i]:.3g}; widen its bounds or free the "
                "time.",
            )
        )
    return out


def _wall(extremal: Extremal) -> str:
    """The bound or path constraint with the largest multiplier: what the search pressed against."""
    problem, m, size = extremal.problem, extremal.multipliers, _sizes(extremal)
    h: Any = rates(extremal.stated, extremal.t, extremal.x, extremal.u)[2]
    paths = [f"path constraint {i}" for i in range(h.shape[1])]
    kinds: Any = (
        (problem.state_names, m.state, extremal.x, problem.state_bounds, size.x),
        (problem.control_names, m.control, extremal.u, problem.control_bounds, size.u),
        (paths, m.path, h, problem.path_bounds, size.path),
    )
    names = [f"{name}" for names, *_ in kinds for name in names]
    force = np.concatenate([np.abs(np.asarray(by)) * of[None] for _, by, _, _, of in kinds], axis=1)
    force = np.nan_to_num(force, nan=0.0, posinf=np.finfo(float).max)
    if not force.size or not force.max() > 0:
        return ""
    k, i = np.unravel_index(int(np.argmax(force)), force.shape)
    sign = np.concatenate([np.asarray(by) for _, by, *_ in kinds], axis=1)[k, i]
    value = np.concatenate([np.asarray(v) for _, _, v, *_ in kinds], axis=1)[k, i]
    sides = [_sides(bounds, v.shape[1]) for _, _, v, bounds, _ in kinds]
    bound = np.concatenate([hi if sign > 0 else lo for lo, hi in sides])[i]
    side = "upper" if sign > 0 else "lower"
    return (
        f"The search pressed hardest against the {side} bound {bound:g} of {names[i]} at node {k} "
        f"(t = {float(extremal.t[k]):.6g}, value {float(value):.6g}); relax it first."
    )


def _worst_defect(extremal: Extremal, size: Any) -> tuple[float, str]:
    """Where the dynamics are missed most at the nodes, over a segment."""
    problem, times = extremal.problem, extremal.by_segment(extremal.t[:, None])[..., 0]
    half = np.diff(extremal.breaks) / 2
    gap = defects(extremal, extremal.reference_nodes) * half[:, None, None]
    gap = np.abs(np.array(gap))
    gap[:, 0] = 0.0  # no node of Radau's grid
    gap[~np.isfinite(gap)] = 0.0
    relative = gap / size.x
    s, k, i = np.unravel_index(int(np.argmax(relative)), gap.shape)
    free = initially_free(problem)
    return float(relative[s, k, i]), (
        f"The dynamics of {problem.state_names[i]} are missed by {gap[s, k, i]:.3g} over segment "
        f"{s} (t = {float(times[s, k]):.6g}); the constraints leave no control that follows them: "
        f"relax one{'' if any(free) else ', free a component of the initial state'} or the time."
    )


def _sides(bounds: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds, (size,) each."""
    lo, hi = bounds_of(bounds, size, jnp.result_type(float))
    return np.asarray(lo), np.asarray(hi)


def _sizes(extremal: Extremal) -> Any:
    """Sizes along the last iterate as NumPy's arrays, 1 where they are not finite."""
    usable = lambda a: np.where(np.isfinite(np.asarray(a)), a, 1.0)
    return jax.tree_util.tree_map(usable, extremal.sizes())
