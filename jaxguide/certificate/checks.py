"""The rows of a certificate, one function for each kind of condition.

**Source:** 2002 paper eqs (2)-(9); review, section 4.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, eigvalsh, on_numpy, xp
from jaxguide.bounds import bound_size, overstep, slackness
from jaxguide.certificate.along import Along, hamiltonian_along
from jaxguide.certificate.table import Checks
from jaxguide.conditions.bounded import bound_errors, oversteps_between
from jaxguide.conditions.hamiltonian import constrained_hamiltonian, endpoint_lagrangian
from jaxguide.host.compilation import compiled
from jaxguide.problem import (
    Chosen,
    Problem,
    initial_bounds,
    initial_values,
    initially_free,
    is_free,
)
from jaxguide.problem.points import control_curvature
from jaxguide.spectral import nodes_lg
from jaxguide.spectral.either import to_legendre


def _costates(problem: Problem) -> tuple[str, ...]:
    return tuple(f"costate of {name}" for name in problem.state_names)


def canonical_equations(rows: Checks, a: Along, tight: float) -> None:
    """Canonical equations, 2002 paper, eqs (2), (6), in integral form on Gauss points between the
    nodes."""
    problem, size, after = a.extremal.problem, a.size, a.breaks[1:]
    f, h_x = a.at_gauss.f, a.at_gauss.by_x
    change = lambda parts: parts[:, -1] - parts[:, 0]
    gap = (change(a.parts[1]) - a.integrals(f)) / size.x[None]
    rows.add("state equation", problem.state_names, gap, after, tight)
    gap = (change(a.parts[3]) + a.integrals(h_x)) / size.costate[None]
    rows.add("costate equation", _costates(problem), gap, after, tight)


def boundary(rows: Checks, a: Along, tight: float) -> None:
    """Boundary data and transversality: 2002 paper, eqs (3), (8), (9)."""
    extremal, size, (x0, xf, t0, tf) = a.extremal, a.size, a.ends()
    problem, nu, costate = extremal.problem, extremal.multipliers.endpoint, extremal.costate
    e = a.at_ends.value[1:]
    labels = [f"constraint {i}" for i in range(e.shape[0])]
    miss = overstep(e, problem.endpoint_bounds) / size.end
    rows.add("endpoint constraints", labels, miss[None], tf[None], tight)
    signs = slackness(nu, e, problem.endpoint_bounds, size.end) * size.end / size.cost
    rows.add("complementarity, ends", labels, signs[None], tf[None], tight)
    given, within = initial_values(problem, x0.dtype), initial_bounds(problem)
    free = np.asarray(initially_free(problem))
    miss = xp.where(free, overstep(x0, within), x0 - given) / size.x
    rows.add("initial state", problem.state_names, miss[None], t0[None], tight)
    # A bound met at either end may have a covector of its own there.
    g = a.endpoint_gradient()
    gap = slackness(costate[-1] - g[1], xf, problem.state_bounds, size.x) / size.costate
    rows.add("transversality, end", _costates(problem), gap[None], tf[None], tight)
    if any(initially_free(problem)):
        gap = slackness(-(costate[0] + g[0]), x0, within, size.x) / size.costate
        gap = xp.where(free, gap, 0.0)
        rows.add("transversality, start", _costates(problem), gap[None], t0[None], tight)


def energy(rows: Checks, a: Along, tight: float) -> None:
    """The Hamiltonian: dH/dt = H_t along the extremal, and its values at free times."""
    extremal, size, (_, _, t0, tf) = a.extremal, a.size, a.ends()
    problem, half = extremal.problem, a.half
    step = extremal.reference_nodes.shape[0] - 1
    g = a.endpoint_gradient()
    h_node = a.at_nodes.hamiltonian
    of_time = lambda gap, t, entry: (
        slackness(gap[None], t[None], (entry.lo, entry.hi), size.t[None])[None] / size.hamiltonian
    )
    if is_free(problem.initial_time):
        gap = of_time(h_node[0] - g[2], t0, problem.initial_time)
        rows.add("H at the start", ("H",), gap, t0[None], tight)
    if is_free(problem.final_time):
        gap = of_time(-(h_node[-1] + g[3]), tf, problem.final_time)
        rows.add("H at the end", ("H",), gap, tf[None], tight)
    drift = xp.cumsum(a.integrals(a.at_gauss.by_t))
    gap = (h_node[step::step] - h_node[0] - drift) / size.hamiltonian
    rows.add("Hamiltonian rate", ("H",), gap[:, None], a.breaks[1:], tight)
    if is_free(problem.final_time):
        # Where controls jump between nodes the pointwise value misleads; its mean by the nodes' own
        # quadrature, 1/2 sum_i w_i H_i on each segment, does not.
        own = to_legendre(extremal.reference_nodes)[0]
        parts = hamiltonian_along(extremal.stated, *a.parts).hamiltonian
        mean = xp.sum(2 * half * (parts @ own)) / (tf - t0)
        ahead = drift[-1] - xp.concatenate([xp.zeros_like(drift[:1]), drift[:-1]])
        ahead = xp.sum(half * 2 * ahead) / (tf - t0)
        gap = of_time(-(mean + ahead + g[3]), tf, problem.final_time)
        rows.add("H on average", ("H",), gap, tf[None], tight)


def jumps(rows: Checks, a: Along, tight: float) -> None:
    """At a break the costate may jump by the covector of a state bound that is met there, and by
    nothing else."""
    extremal, step = a.extremal, a.extremal.reference_nodes.shape[0] - 1
    if extremal.costate_before is None:
        return
    by = extremal.costate_before[:-1] - extremal.costate[step:-1:step]
    held = slackness(by, extremal.x[step:-1:step], extremal.problem.state_bounds, a.size.x)
    gap = held / a.size.costate[None]
    rows.add("costate jumps", _costates(extremal.problem), gap, a.breaks[1:-1], tight)


def stationarity(rows: Checks, a: Along, tight: float) -> None:
    """H bar stationary in the control, and convex (Legendre-Clebsch)."""
    extremal, size, problem = a.extremal, a.size, a.extremal.problem
    if not problem.m:
        return
    t, names = extremal.t, problem.control_names
    gap = a.at_nodes.by_u * (size.u / size.hamiltonian)[None]
    rows.add("stationarity H_u", names, gap, t, tight)
    if extremal.parametric:
        # Of node values: H_u vanishes weighted by the hat function of each node (thesis, eq. 4.33).
        inside, hat = a.at_gauss.by_u, lambda sign: (1 + sign * a.gauss)[None, :, None] / 2
        before, after = (a.integrals(hat(sign) * inside) for sign in (-1, 1))
        none = xp.zeros_like(before[:1])
        hats = xp.concatenate([before, none]) + xp.concatenate([none, after])
        hats = hats * (size.u / (size.hamiltonian * size.t))[None]
        rows.add("stationarity of node values", names, hats, a.breaks, tight)
    h_uu = control_curvature(extremal.stated, t, extremal.x, extremal.u, extremal.costate)
    least = h_uu[:, 0, 0] if problem.m == 1 else eigvalsh(h_uu)[:, 0]
    # Minus the least eigenvalue, so that the row passes if it is <= 0.
    worst = xp.argmin(least)
    rows.add_signed("Legendre-Clebsch", ("-min eig H_uu",), -least[worst], t[worst], 0.0)


def bounds(rows: Checks, a: Along, tight: float) -> None:
    """Path constraints, states and controls within bounds, and the signs of their covectors. Path
    constraints and states are looked at between the nodes too; a control is flown within its
    bounds (`Extremal.__call__`)."""
    extremal, problem, t = a.extremal, a.extremal.problem, a.extremal.t
    m = extremal.multipliers
    covectors = (m.path, m.state, m.control)
    found = bound_errors(extremal.stated, t, extremal.x, extremal.u, covectors, a.size)
    paths = tuple(f"path {i}" for i in range(found.path.shape[1]))
    states, controls = problem.state_names, problem.control_names
    h, (times, x, _, _, _), size = a.at_gauss.path, a.between, (a.size.path, a.size.x)
    inside = oversteps_between(problem, nodes_lg(2 * extremal.degree)[0], (h, x), size)
    path, state = (over.reshape(times.size, over.shape[2]) for over in inside)
    both, times = (
        lambda at, over: xp.concatenate([at, over]),
        xp.concatenate([t, times.reshape(-1)]),
    )
    rows.add("path constraints", paths, both(found.path, path), times, tight)
    rows.add("state bounds", states, both(found.state, state), times, tight)
    rows.add("control bounds", controls, found.control, t, tight)
    rows.add("complementarity", paths + states + controls, found.complementarity, t, tight)


def integrals(rows: Checks, a: Along, tight: float) -> None:
    """Integral constraints, and the signs of their covectors."""
    problem, r, tf = a.extremal.problem, a.extremal.multipliers.integral, a.extremal.t[-1]
    each = a.at_gauss.integrands
    total = lambda values: xp.sum(a.integrals(values), axis=0)
    gained, within = total(each), problem.integral_bounds
    of = bound_size(total(xp.abs(each)), within)
    labels = tuple(f"integral {i}" for i in range(gained.shape[0]))
    rows.add("integral constraints", labels, (overstep(gained, within) / of)[None], tf[None], tight)
    signs = slackness(r, gained, within, of) * of / a.size.cost
    rows.add("complementarity, integrals", labels, signs[None], tf[None], tight)


def static_parameters(rows: Checks, a: Along, tight: float) -> None:
    """Static parameters: the gradient of Ebar + int H bar dt vanishes, or a bound holds it."""
    extremal, problem = a.extremal, a.extremal.problem
    chosen, tf = extremal.chosen, extremal.t[-1]
    if chosen is None:
        return

    p = chosen.values(problem)
    given = (chosen, problem, extremal.multipliers.endpoint, a.ends(), a.between, a.half, a.weights)
    if on_numpy(extremal.t):
        slope = jax.device_get(compiled(_by_parameters, True)(*given))
    else:
        slope = _by_parameters(*given)
    of = bound_size(p, chosen.bounds)
    gap = slackness(-slope, p, chosen.bounds, of) * of / a.size.cost
    rows.add("static parameters", chosen.names, gap[None], tf[None], tight)


def _by_parameters(
    chosen: Chosen,
    problem: Problem,
    nu: Array,
    ends: Any,
    between: Any,
    half: Array,
    weights: Array,
) -> Float[Array, " k"]:
    """Gradient of Ebar + int H bar dt by the static parameters."""

    def lagrangian(p: Array) -> Array:
        other = chosen.into(problem, p)
        h = jax.vmap(jax.vmap(lambda *at: constrained_hamiltonian(other, *at)))(*between)
        return endpoint_lagrangian(other, nu, *ends) + jnp.sum(half * (h @ weights))

    return jax.grad(lagrangian)(chosen.values(problem))


def spectral_tails(rows: Checks, a: Along, tight: float) -> None:
    """Spectral tails: the last two Legendre coefficients of each segment's polynomial."""
    problem, last = a.extremal.problem, to_legendre(a.extremal.reference_nodes)[-2:]
    tail = lambda parts, of: (
        xp.max(xp.abs(xp.einsum("rp,spk->srk", last, parts)), axis=1) / of[None]
    )
    state, costate = tail(a.parts[1], a.size.x), tail(a.parts[3], a.size.costate)
    rows.add("spectral tail, state", problem.state_names, state, a.breaks[1:], tight)
    rows.add("spectral tail, costate", _costates(problem), costate, a.breaks[1:], tight)
