"""The Certificate: how good an extremal is, each necessary condition as a number with its bound."""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.neighboring.linearization import terminal_conditions
from jaxguide.neighboring.segmented import NODES, SEGMENTS, SWEEPS, conjugate_ahead, solve_sweeps
from jaxguide.nominal.conditions import endpoint_lagrangian
from jaxguide.nominal.wrappers import closed
from jaxguide.problem import (
    Free,
    Problem,
    bounds_of,
    hamiltonian,
    initial_entries,
    initial_values,
    initially_free,
    is_free,
)
from jaxguide.sizes import sizes_of
from jaxguide.spectral import interpolation_matrix, legendre_matrix, nodes_lg
from jaxguide.trajectory import Extremal


class Certificate(eqx.Module):
    """Rows of checks. `passed` is a bool array; printed, a table that names the worst place.

    Of a batch of extremals every array has a leading axis of lanes; printed, each row is that of
    the worst lane."""

    names: tuple[str, ...] = eqx.field(static=True)
    labels: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    value: Float[Array, " row"]
    tolerance: Float[Array, " row"]
    time: Float[Array, " row"]
    component: Array

    @property
    def passed(self) -> Bool[Array, " row"]:
        return self.value <= self.tolerance  # NaN fails

    def worst(self) -> "Certificate":
        """Of a batch: each row in the lane where it is furthest beyond its bound."""
        beyond = jnp.where(
            jnp.isnan(self.value), jnp.inf, self.value / jnp.maximum(self.tolerance, 1e-300)
        )
        lane = jnp.argmax(beyond, axis=0)
        pick = lambda a: jnp.take_along_axis(a, lane[None], axis=0)[0]
        return jax.tree_util.tree_map(pick, self)

    def __str__(self) -> str:
        if self.value.ndim == 2:
            passed = np.asarray(jnp.all(self.passed, axis=1))
            return f"{passed.sum()} of {len(passed)} lanes pass; at worst:\n{self.worst()}"
        width = max(len(name) for name in self.names)
        lines = []
        rows = zip(
            self.names,
            self.labels,
            np.asarray(self.value),
            np.asarray(self.tolerance),
            np.asarray(self.time),
            np.asarray(self.component),
            np.asarray(self.passed),
            strict=True,
        )
        for name, labels, value, tolerance, time, component, passed in rows:
            where = f"{labels[int(component) % len(labels)]} at t = {time:.6g}" if labels else ""
            verdict = "ok   " if passed else "FAILS"
            lines.append(f"{verdict} {name:{width}s} {value:9.2e} <= {tolerance:7.1e}  {where}")
        return "\n".join(lines)

    def rows(self) -> list[dict[str, Any]]:
        """The table as plain data; of a batch, at its worst."""
        if self.value.ndim == 2:
            return self.worst().rows()
        return [
            {
                "check": name,
                "value": float(v),
                "tolerance": float(tol),
                "time": float(t),
                "where": labels[int(c) % len(labels)] if labels else "",
                "passed": bool(p),
            }
            for name, labels, v, tol, t, c, p in zip(
                self.names, self.labels, self.value, self.tolerance, self.time, self.component,
                self.passed, strict=True,
            )
        ]  # fmt: skip


class _Rows:
    """Collects rows while the checks are traced."""

    def __init__(self):
        self.names, self.labels = [], []
        self.value, self.tolerance, self.time, self.component = [], [], [], []

    def add(self, name: str, labels: Any, values: Array, times: Array, tolerance: float) -> None:
        """`values` (k, c): errors of components named by `labels` at `times` (k,)."""
        if values.size == 0:
            return
        values = jnp.abs(values)
        flat = jnp.where(jnp.isnan(values), jnp.inf, values)
        worst = jnp.argmax(flat)
        node, component = worst // values.shape[1], worst % values.shape[1]
        self.names.append(name)
        self.labels.append(tuple(labels))
        self.value.append(values[node, component])
        self.tolerance.append(jnp.asarray(tolerance, values.dtype))
        self.time.append(times[node])
        self.component.append(component)

    def add_signed(
        self, name: str, labels: Any, value: Array, time: Array, tolerance: float
    ) -> None:
        """One signed number that must not exceed `tolerance`."""
        self.names.append(name)
        self.labels.append(tuple(labels))
        self.value.append(value)
        self.tolerance.append(jnp.asarray(tolerance, value.dtype))
        self.time.append(time)
        self.component.append(jnp.zeros((), jnp.int64 if value.dtype == jnp.float64 else jnp.int32))

    def done(self) -> Certificate:
        stack = jnp.stack
        return Certificate(
            tuple(self.names),
            tuple(self.labels),
            stack(self.value),
            stack(self.tolerance),
            stack(self.time),
            stack(self.component),
        )


def certify(extremal: Extremal, costly: bool = False, tolerance: float = 1e-9) -> Certificate:
    """Checks an extremal against the conditions it should meet, independently of its solver.

    **Arguments:** `tolerance`: of the relative errors; `costly`: also fly the interpolated control
    with an adaptive integrator (Diffrax, 1e-11) and compare with the extremal's own states; and
    look for conjugate points, past which an extremal minimises nothing, by a backward sweep of its
    second variation. Errors are relative to the size of what is compared, so the tolerance holds
    in any units.

    **Source:** 2002 paper eqs (2)-(9); review, section 4.
    """
    return _checks(extremal, costly, tolerance)


@functools.cache
def certifier(tolerance: float) -> Callable[[Extremal], Certificate]:
    """`certify` to a tolerance: one function for each, so that equal ones compile once."""
    return functools.partial(certify, tolerance=tolerance)


def constrained_hamiltonian(
    problem: Problem, t: Any, x: Array, u: Array, costate: Array, held: Array
) -> Float[Array, ""]:
    """H with the multipliers `held` of path constraints, states, controls and integrals: review,
    H bar."""
    h, r = problem.path_constraints(t, x, u), problem.integrands(t, x, u)
    return hamiltonian(problem, t, x, u, costate) + jnp.dot(held, jnp.concatenate([h, x, u, r]))


@eqx.filter_jit
def _checks(extremal: Extremal, costly: bool, tight: float) -> Certificate:
    if extremal.stretch is not None:
        extremal = closed(extremal)
    problem, t = extremal.problem, extremal.t
    x, u, costate = extremal.x, extremal.u, extremal.costate
    rows = _Rows()
    states = problem.state_names
    costates = tuple(f"costate of {name}" for name in states)
    size, multipliers = sizes_of(extremal), extremal.multipliers

    if costly:
        flown = _propagate(extremal)
        rows.add("propagated state", states, (flown - x) / size.x[None], t, 1e-8)
        # The last break with one ahead is just before it: 1 there, 0 where there is none.
        ahead = _conjugate(extremal)
        last = jnp.where(jnp.any(ahead), ahead.shape[0] - 1 - jnp.argmax(ahead[::-1]), 0)
        count = jnp.any(ahead).astype(t.dtype)
        rows.add_signed("conjugate points", ("one follows",), count, extremal.breaks[last], 0.0)

    # Canonical equations, eqs (2) and (6), in integral form on Gauss points between the nodes.
    gauss, weights = (jnp.asarray(a, t.dtype) for a in nodes_lg(2 * extremal.degree))
    breaks = extremal.breaks
    half = jnp.diff(breaks) / 2
    mid = (breaks[1:] + breaks[:-1]) / 2
    times = mid[:, None] + half[:, None] * gauss[None, :]
    to_gauss = interpolation_matrix(extremal.reference_nodes, gauss)
    at = lambda parts: jnp.einsum("gp,spk->sgk", to_gauss, parts)
    u_parts, lam_parts = extremal.control_by_segment(), extremal.costate_by_segment()
    gx, gu, glam = at(extremal.by_segment(x)), at(u_parts), at(lam_parts)
    integral = jnp.broadcast_to(multipliers.integral, (len(t), len(multipliers.integral)))
    constraints = (multipliers.path, multipliers.state, multipliers.control)
    held = jnp.concatenate([*constraints, integral], axis=1)
    gheld = at(extremal.by_segment(held))
    over = lambda f: jax.vmap(jax.vmap(lambda t, x, u, c, k: f(problem, t, x, u, c, k)))
    f = over(lambda p, t, x, u, c, k: p.dynamics(t, x, u))(times, gx, gu, glam, gheld)
    h_x = over(jax.grad(constrained_hamiltonian, argnums=2))(times, gx, gu, glam, gheld)
    quad = lambda v: half[:, None] * jnp.einsum("g,sgk->sk", weights, v)
    step = extremal.reference_nodes.shape[0] - 1
    ends = lambda parts: parts[:, -1] - parts[:, 0]
    moved, turned = ends(extremal.by_segment(x)), ends(lam_parts)
    rows.add("state equation", states, (moved - quad(f)) / size.x[None], breaks[1:], tight)
    scaled = (turned + quad(h_x)) / size.costate[None]
    rows.add("costate equation", costates, scaled, breaks[1:], tight)

    # Boundary data and transversality, eqs (3), (8), (9).
    x0, xf, t0, tf = x[0], x[-1], t[0], t[-1]
    e = problem.endpoint_constraints(x0, xf, t0, tf)
    labels = [f"constraint {i}" for i in range(e.shape[0])]
    miss = _overstep(e, problem.endpoint_bounds) / size.end
    rows.add("endpoint constraints", labels, miss[None], tf[None], tight)
    g = jax.grad(endpoint_lagrangian, argnums=(2, 3, 4, 5))(
        problem, multipliers.endpoint, x0, xf, t0, tf
    )
    signs = _slackness(multipliers.endpoint, e, problem.endpoint_bounds, size.end)
    signs = signs * size.end / size.cost
    rows.add("complementarity, ends", labels, signs[None], tf[None], tight)
    given, free = initial_values(problem, x.dtype), jnp.asarray(initially_free(problem))
    miss = jnp.where(free, _overstep(x0, _initial_bounds(problem)), x0 - given) / size.x
    rows.add("initial state", states, miss[None], t0[None], tight)
    # A bound met at either end may have a covector of its own there.
    gap = _slackness(costate[-1] - g[1], xf, problem.state_bounds, size.x) / size.costate
    rows.add("transversality, end", costates, gap[None], tf[None], tight)
    if any(initially_free(problem)):
        gap = _slackness(-(costate[0] + g[0]), x0, _initial_bounds(problem), size.x) / size.costate
        gap = jnp.where(free, gap, 0.0)
        rows.add("transversality, start", costates, gap[None], t0[None], tight)

    # The Hamiltonian: stationary in u, and dH/dt = H_t along the extremal.
    def value(t: Any, x: Array, u: Array, costate: Array) -> Array:
        gain = jnp.dot(multipliers.integral, problem.integrands(t, x, u))
        return hamiltonian(problem, t, x, u, costate) + gain

    h_node = jax.vmap(value)(t, x, u, costate)
    of_time = lambda gap, t, entry: (
        _slackness(gap[None], t[None], (entry.lo, entry.hi), size.t[None])[None] / size.hamiltonian
    )
    if is_free(problem.initial_time):
        gap = of_time(h_node[0] - g[2], t0, problem.initial_time)
        rows.add("H at the start", ("H",), gap, t0[None], tight)
    if is_free(problem.final_time):
        gap = of_time(-(h_node[-1] + g[3]), tf, problem.final_time)
        rows.add("H at the end", ("H",), gap, tf[None], tight)
    h_t = over(jax.grad(constrained_hamiltonian, argnums=1))(times, gx, gu, glam, gheld)
    if extremal.costate_before is not None:
        # At a break the costate may jump, by a covector of a bound that is met there.
        jumps = extremal.costate_before[:-1] - costate[step:-1:step]
        held_there = jax.vmap(_slackness, in_axes=(0, 0, None, None))(
            jumps, x[step:-1:step], problem.state_bounds, size.x
        )
        rows.add("costate jumps", costates, held_there / size.costate[None], breaks[1:-1], tight)
    drift = jnp.cumsum(half * jnp.einsum("g,sg->s", weights, h_t))
    gap = (h_node[step::step] - h_node[0] - drift) / size.hamiltonian
    rows.add("Hamiltonian rate", ("H",), gap[:, None], breaks[1:], tight)
    if is_free(problem.final_time):
        # Where controls jump between nodes the pointwise value misleads; its mean, by the nodes'
        # own quadrature, does not (reference: 1/2 sum w lambda^T f).
        own = legendre_matrix(extremal.reference_nodes)[0]
        of_parts = lambda t, x, u, c: jax.vmap(jax.vmap(value))(t, x, u, c)
        parts = of_parts(
            extremal.by_segment(t[:, None])[..., 0], extremal.by_segment(x), u_parts, lam_parts
        )
        mean = jnp.sum(2 * half * (parts @ own)) / (tf - t0)
        ahead = drift[-1] - jnp.concatenate([jnp.zeros(1, t.dtype), drift[:-1]])
        ahead = jnp.sum(half * 2 * ahead) / (tf - t0)
        gap = of_time(-(mean + ahead + g[3]), tf, problem.final_time)
        rows.add("H on average", ("H",), gap, tf[None], tight)
    h_u = jax.vmap(jax.grad(constrained_hamiltonian, argnums=3), in_axes=(None, 0, 0, 0, 0, 0))(
        problem, t, x, u, costate, held
    )
    scaled = h_u * (size.u / size.hamiltonian)[None]
    rows.add("stationarity H_u", problem.control_names, scaled, t, tight)
    if extremal.parametric:
        # Of node values: H_u vanishes weighted by the hat function of each node (thesis, eq. 4.33).
        inside = over(jax.grad(constrained_hamiltonian, argnums=3))(times, gx, gu, glam, gheld)
        before, after = (quad((1 + sign * gauss)[None, :, None] / 2 * inside) for sign in (-1, 1))
        none = jnp.zeros_like(before[:1])
        hats = jnp.concatenate([before, none]) + jnp.concatenate([none, after])
        hats = hats * (size.u / (size.hamiltonian * size.t))[None]
        rows.add("stationarity of node values", problem.control_names, hats, breaks, tight)
    h_uu = jax.vmap(jax.hessian(hamiltonian, argnums=3), in_axes=(None, 0, 0, 0, 0))(
        problem, t, x, u, costate
    )
    least = h_uu[:, 0, 0] if problem.m == 1 else jnp.linalg.eigvalsh(h_uu)[:, 0]
    # Legendre-Clebsch: the row is minus the least eigenvalue, so that <= 0 is what is wanted.
    worst = jnp.argmin(least)
    rows.add_signed("Legendre-Clebsch", ("-min eig H_uu",), -least[worst], t[worst], 0.0)

    h = jax.vmap(problem.path_constraints)(t, x, u)
    paths = tuple(f"path {i}" for i in range(h.shape[1]))
    kinds = (
        ("path constraints", paths, h, problem.path_bounds, multipliers.path, size.path),
        ("state bounds", states, x, problem.state_bounds, multipliers.state, size.x),
        (
            "control bounds", problem.control_names, u, problem.control_bounds,
            multipliers.control, size.u,
        ),
    )  # fmt: skip
    for name, labels, values, bounds, _, of in kinds:
        rows.add(name, labels, _overstep(values, bounds) / of[None], t, tight)
    slack = jax.vmap(_slackness, in_axes=(0, 0, None, None))
    signs = [slack(m, values, bounds, of) * of[None] for _, _, values, bounds, m, of in kinds]
    signs = jnp.concatenate(signs, axis=1) / size.hamiltonian
    labels = paths + states + problem.control_names
    rows.add("complementarity", labels, signs, t, tight)

    each = jax.vmap(jax.vmap(problem.integrands))(times, gx, gu)
    gains = jnp.sum(quad(each), axis=0)
    labels = tuple(f"integral {i}" for i in range(gains.shape[0]))
    of = _bound_size(jnp.sum(quad(jnp.abs(each)), axis=0), problem.integral_bounds)
    miss = _overstep(gains, problem.integral_bounds) / of
    rows.add("integral constraints", labels, miss[None], tf[None], tight)
    signs = _slackness(multipliers.integral, gains, problem.integral_bounds, of) * of / size.cost
    rows.add("complementarity, integrals", labels, signs[None], tf[None], tight)

    if extremal.chosen is not None:
        # Static parameters: the gradient of Ebar + int H bar dt vanishes, or a bound holds it.
        def lagrangian(p: Array) -> Array:
            other = extremal.chosen.into(problem, p)
            ends = endpoint_lagrangian(other, multipliers.endpoint, x0, xf, t0, tf)
            along = over(lambda _, *at: constrained_hamiltonian(other, *at))
            return ends + jnp.sum(quad(along(times, gx, gu, glam, gheld)[..., None]))

        p = extremal.chosen.values(problem)
        of = _bound_size(p, extremal.chosen.bounds)
        gap = _slackness(-jax.grad(lagrangian)(p), p, extremal.chosen.bounds, of) * of / size.cost
        labels = extremal.chosen.names
        rows.add("static parameters", labels, gap[None], tf[None], tight)

    # Spectral tail: the last two Legendre coefficients of each segment's polynomial.
    inverse = legendre_matrix(extremal.reference_nodes)[-2:]
    tail = lambda v, of: jnp.max(jnp.abs(jnp.einsum("rp,spk->srk", inverse, v)), axis=1) / of[None]
    rows.add(
        "spectral tail, state", states, tail(extremal.by_segment(x), size.x), breaks[1:], tight
    )
    rows.add("spectral tail, costate", costates, tail(lam_parts, size.costate), breaks[1:], tight)
    return rows.done()


def _slackness(
    multiplier: Float[Array, " k"], values: Float[Array, " k"], bounds: Any, size: Array
) -> Float[Array, " k"]:
    """|multiplier| times the distance from the bound that its sign names, in sizes: zero where a
    bound is active with the right sign, or let go."""
    lo, hi = bounds_of(bounds, values.shape[0], values.dtype)
    distance = jnp.where(multiplier > 0, hi - values, values - lo) / size
    # Beyond a size of one, as for a bound at infinity, the multiplier alone counts.
    return jnp.abs(multiplier) * jnp.clip(distance, 0.0, 1.0)


def _overstep(values: Float[Array, "*k c"], bounds: Any) -> Float[Array, "*k c"]:
    """How far `values` lie outside their bounds."""
    sides = bounds_of(bounds, values.shape[-1], values.dtype)
    lo, hi = (jnp.broadcast_to(b, values.shape) for b in sides)
    return jnp.maximum(lo - values, 0.0) + jnp.maximum(values - hi, 0.0)


def _initial_bounds(problem: Problem) -> tuple[Array, Array]:
    """Of the initial state, where it is free: its own and those of every state."""
    lo, hi = bounds_of(problem.state_bounds, problem.n, jnp.result_type(float))
    entries = [e if is_free(e) else Free() for e in initial_entries(problem)]
    own = [jnp.stack([jnp.asarray(getattr(e, k), lo.dtype) for e in entries]) for k in ("lo", "hi")]
    return jnp.maximum(lo, own[0]), jnp.minimum(hi, own[1])


def _bound_size(values: Float[Array, " k"], bounds: Any) -> Float[Array, " k"]:
    """The largest of a value and its finite bounds; 1 if that is zero."""
    both = jnp.stack([*bounds_of(bounds, values.shape[0], values.dtype), values])
    size = jnp.max(jnp.where(jnp.isfinite(both), jnp.abs(both), 0.0), axis=0)
    return jnp.where(size > 0, size, 1.0)


def _propagate(extremal: Extremal) -> Array:
    """States flown from x(t0) with the interpolated control, at the nodes."""
    problem: Problem = extremal.problem
    rate = lambda t, x, args: problem.dynamics(t, x, extremal.interpolate(extremal.u, t))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        diffrax.Dopri8(),
        extremal.t[0],
        extremal.t[-1],
        None,
        extremal.x[0],
        stepsize_controller=diffrax.PIDController(rtol=1e-11, atol=1e-11),
        saveat=diffrax.SaveAt(ts=extremal.t),
        max_steps=16384,
        throw=False,
    )
    assert solution.ys is not None
    return solution.ys


def _conjugate(extremal: Extremal) -> Bool[Array, " break"]:
    """Whether a conjugate point lies between each break of the mesh (the last left out) and tf."""
    terminal, times = terminal_conditions(extremal), extremal.breaks[:-1]
    pair = solve_sweeps(extremal, terminal, times, SEGMENTS, NODES, SWEEPS, ())
    return conjugate_ahead(pair.sweep, times)
