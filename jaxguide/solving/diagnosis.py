"""What is wrong with an extremal that was not found: the worst constraint by name, node, time and
value, in the user's units. Host only."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.bounds import bounds_of
from jaxguide.problem import Problem, initially_free
from jaxguide.spectral import differentiation_matrix
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS

_NEGLIGIBLE = 1e-8  # of a constraint's size: no miss


def why(extremal: Extremal) -> str:
    """One sentence or two: the reason, the worst miss, what to try."""
    problem = extremal.problem
    said = [f"{type(problem).__name__}: {RESULTS[extremal.result]}"]
    undefined = _undefined(extremal)
    if undefined:
        said.append(undefined)
    else:
        misses = sorted(_misses(extremal), key=lambda m: -m[0])
        said += [text for size, text in misses[:2] if size > _NEGLIGIBLE]
    said.append(f"Largest scaled residual {float(extremal.residual):.2e}.")
    return " ".join(said)


def _undefined(extremal: Extremal) -> str:
    """Where the problem's functions, or their derivatives, leave finite numbers."""
    problem, t, x, u = extremal.problem, extremal.t, extremal.x, extremal.u
    t = jnp.where(jnp.isfinite(t), t, 0.0)
    for name, values in (("state", x), ("control", u)):
        if not np.all(np.isfinite(np.asarray(values))):
            return f"The last iterate's {name} left finite numbers."
    for name in ("dynamics", "running_cost", "path_constraints", "integrands"):
        function = getattr(problem, name)
        value = jax.vmap(function)(t, x, u)
        slopes = jax.vmap(jax.jacfwd(function, argnums=(1, 2)))(t, x, u)
        for what, array in ((name, value), *((f"a derivative of {name}", s) for s in slopes)):
            found = _first_undefined(array.reshape(len(t), -1))
            if found:
                k, i, bad = found
                if what == "dynamics":
                    what = f"dynamics: d({problem.state_names[i]})/dt"
                return (
                    f"{what} is {bad} at node {k} (t = {float(t[k]):.6g}, x = {np.asarray(x[k])}, "
                    f"u = {np.asarray(u[k])}); keep clear of the singularity by state bounds or a "
                    "guess, or mend the equation."
                )
    ends = (x[0], x[-1], t[0], t[-1])
    for name in ("endpoint_cost", "endpoint_constraints"):
        function = getattr(problem, name)
        slopes = jax.jacfwd(function, argnums=(0, 1, 2, 3))(*ends)
        for what, array in (
            (name, function(*ends)),
            *((f"a derivative of {name}", s) for s in slopes),
        ):
            found = _first_undefined(jnp.reshape(array, (1, -1)))
            if found:
                return (
                    f"{what} is {found[2]} at x0 = {np.asarray(x[0])}, xf = {np.asarray(x[-1])}, "
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
    """(relative size, sentence) of the worst of each kind of constraint."""
    problem, t = extremal.problem, np.asarray(extremal.t)
    x, u = np.asarray(extremal.x), np.asarray(extremal.u)
    out = []
    e = np.asarray(problem.endpoint_constraints(extremal.x[0], extremal.x[-1], t[0], t[-1]))
    lo, hi = _sides(problem.endpoint_bounds, len(e))
    miss = np.maximum(lo - e, 0) + np.maximum(e - hi, 0)
    if len(e):
        i = int(np.argmax(miss / _size(lo, hi, e)))
        out.append(
            (
                float((miss / _size(lo, hi, e))[i]),
                f"Endpoint constraint {i} misses its bounds by {miss[i]:.3g} (value {e[i]:.6g}, "
                f"bounds [{lo[i]:g}, {hi[i]:g}]); if it contradicts another or lies out of reach, "
                "relax it.",
            )
        )
    h = np.asarray(jax.vmap(problem.path_constraints)(extremal.t, extremal.x, extremal.u))
    for what, names, values, bounds in (
        ("State", problem.state_names, x, problem.state_bounds),
        ("Control", problem.control_names, u, problem.control_bounds),
        ("Path constraint", [str(i) for i in range(h.shape[1])], h, problem.path_bounds),
    ):
        if not values.shape[1]:
            continue
        lo, hi = _sides(bounds, values.shape[1])
        miss = np.maximum(lo - values, 0) + np.maximum(values - hi, 0)
        relative = miss / _size(lo, hi, np.abs(values).max(axis=0))
        k, i = np.unravel_index(int(np.argmax(relative)), relative.shape)
        out.append(
            (
                float(relative[k, i]),
                f"{what} {names[i]} is {values[k, i]:.6g} at node {k} (t = {t[k]:.6g}), outside "
                f"[{lo[i]:g}, {hi[i]:g}] by {miss[k, i]:.3g}; widen its bounds or free the time.",
            )
        )
    out.append(_defect(extremal, problem, t))
    return out


def _defect(extremal: Extremal, problem: Problem, t: np.ndarray) -> tuple[float, str]:
    D = differentiation_matrix(extremal.reference_nodes)
    half = jnp.diff(extremal.breaks) / 2
    parts = extremal.by_segment(extremal.x)
    rate = jnp.einsum("kp,spn->skn", D, parts)
    u = extremal.control_by_segment()
    times = extremal.by_segment(extremal.t[:, None])[..., 0]
    f = jax.vmap(jax.vmap(problem.dynamics))(times, parts, u) * half[:, None, None]
    gap = np.array(jnp.abs(rate - f))
    gap[:, 0] = 0.0  # no node of Radau's grid
    gap[~np.isfinite(gap)] = 0.0
    span = np.abs(np.asarray(extremal.x)).max(axis=0) + 1e-3
    s, k, i = np.unravel_index(int(np.argmax(gap / span)), gap.shape)
    free = initially_free(problem)
    return float(gap[s, k, i] / span[i]), (
        f"The dynamics of {problem.state_names[i]} are missed by {gap[s, k, i]:.3g} over segment "
        f"{s} (t = {float(times[s, k]):.6g}); the constraints leave no control that follows them: "
        f"relax one{'' if any(free) else ', free a component of the initial state'} or the time."
    )


def _sides(bounds: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    lo, hi = bounds_of(bounds, size, jnp.result_type(float))
    return np.asarray(lo), np.asarray(hi)


def _size(lo: np.ndarray, hi: np.ndarray, seen: np.ndarray) -> np.ndarray:
    finite = lambda b: np.where(np.isfinite(b), np.abs(b), 0.0)
    return np.maximum(np.maximum(finite(lo), finite(hi)), 1e-3 + 0 * np.abs(seen))
