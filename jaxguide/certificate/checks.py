"""The rows of a certificate, one function for each kind of condition.

**Source:** 2002 paper eqs (2)-(9); review, section 4.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.bounds import bound_size, overstep, slackness
from jaxguide.certificate.along import Along
from jaxguide.certificate.table import Checks
from jaxguide.conditions.bounded import bound_errors, oversteps_between
from jaxguide.conditions.hamiltonian import (
    constrained_hamiltonian,
    endpoint_lagrangian,
    hamiltonian,
)
from jaxguide.problem import Problem, initial_bounds, initial_values, initially_free, is_free
from jaxguide.spectral import legendre_matrix, nodes_lg


def _costates(problem: Problem) -> tuple[str, ...]:
    return tuple(f"costate of {name}" for name in problem.state_names)


def canonical_equations(rows: Checks, a: Along, tight: float) -> None:
    """Canonical equations, 2002 paper, eqs (2), (6), in integral form on Gauss points between the
    nodes."""
    problem, size, after = a.extremal.problem, a.size, a.breaks[1:]
    f = a.at_gauss(lambda p, t, x, u, c, k: p.dynamics(t, x, u))
    h_x = a.at_gauss(jax.grad(constrained_hamiltonian, argnums=2))
    change = lambda parts: parts[:, -1] - parts[:, 0]
    gap = (change(a.parts[1]) - a.integrals(f)) / size.x[None]
    rows.add("state equation", problem.state_names, gap, after, tight)
    gap = (change(a.parts[3]) + a.integrals(h_x)) / size.costate[None]
    rows.add("costate equation", _costates(problem), gap, after, tight)


def boundary(rows: Checks, a: Along, tight: float) -> None:
    """Boundary data and transversality: 2002 paper, eqs (3), (8), (9)."""
    extremal, size, (x0, xf, t0, tf) = a.extremal, a.size, a.ends()
    problem, nu, costate = extremal.problem, extremal.multipliers.endpoint, extremal.costate
    e = problem.endpoint_constraints(x0, xf, t0, tf)
    labels = [f"constraint {i}" for i in range(e.shape[0])]
    miss = overstep(e, problem.endpoint_bounds) / size.end
    rows.add("endpoint constraints", labels, miss[None], tf[None], tight)
    signs = slackness(nu, e, problem.endpoint_bounds, size.end) * size.end / size.cost
    rows.add("complementarity, ends", labels, signs[None], tf[None], tight)
    given, free = initial_values(problem, x0.dtype), jnp.asarray(initially_free(problem))
    miss = jnp.where(free, overstep(x0, initial_bounds(problem)), x0 - given) / size.x
    rows.add("initial state", problem.state_names, miss[None], t0[None], tight)
    # A bound met at either end may have a covector of its own there.
    g = a.endpoint_gradient()
    gap = slackness(costate[-1] - g[1], xf, problem.state_bounds, size.x) / size.costate
    rows.add("transversality, end", _costates(problem), gap[None], tf[None], tight)
    if any(initially_free(problem)):
        gap = slackness(-(costate[0] + g[0]), x0, initial_bounds(problem), size.x) / size.costate
        gap = jnp.where(free, gap, 0.0)
        rows.add("transversality, start", _costates(problem), gap[None], t0[None], tight)


def energy(rows: Checks, a: Along, tight: float) -> None:
    """The Hamiltonian: dH/dt = H_t along the extremal, and its values at free times."""
    extremal, size, (_, _, t0, tf) = a.extremal, a.size, a.ends()
    problem, r, half = extremal.problem, extremal.multipliers.integral, a.half
    step = extremal.reference_nodes.shape[0] - 1

    def value(t: Any, x: Array, u: Array, costate: Array) -> Array:
        return hamiltonian(problem, t, x, u, costate) + jnp.dot(r, problem.integrands(t, x, u))

    g = a.endpoint_gradient()
    h_node = jax.vmap(value)(*a.nodes[:4])
    of_time = lambda gap, t, entry: (
        slackness(gap[None], t[None], (entry.lo, entry.hi), size.t[None])[None] / size.hamiltonian
    )
    if is_free(problem.initial_time):
        gap = of_time(h_node[0] - g[2], t0, problem.initial_time)
        rows.add("H at the start", ("H",), gap, t0[None], tight)
    if is_free(problem.final_time):
        gap = of_time(-(h_node[-1] + g[3]), tf, problem.final_time)
        rows.add("H at the end", ("H",), gap, tf[None], tight)
    drift = jnp.cumsum(a.integrals(a.at_gauss(jax.grad(constrained_hamiltonian, argnums=1))))
    gap = (h_node[step::step] - h_node[0] - drift) / size.hamiltonian
    rows.add("Hamiltonian rate", ("H",), gap[:, None], a.breaks[1:], tight)
    if is_free(problem.final_time):
        # Where controls jump between nodes the pointwise value misleads; its mean by the nodes' own
        # quadrature, 1/2 sum_i w_i H_i on each segment, does not.
        own = legendre_matrix(extremal.reference_nodes)[0]
        parts = jax.vmap(jax.vmap(value))(*a.parts[:4])
        mean = jnp.sum(2 * half * (parts @ own)) / (tf - t0)
        ahead = drift[-1] - jnp.concatenate([jnp.zeros_like(drift[:1]), drift[:-1]])
        ahead = jnp.sum(half * 2 * ahead) / (tf - t0)
        gap = of_time(-(mean + ahead + g[3]), tf, problem.final_time)
        rows.add("H on average", ("H",), gap, tf[None], tight)


def jumps(rows: Checks, a: Along, tight: float) -> None:
    """At a break the costate may jump by the covector of a state bound that is met there, and by
    nothing else."""
    extremal, step = a.extremal, a.extremal.reference_nodes.shape[0] - 1
    if extremal.costate_before is None:
        return
    by = extremal.costate_before[:-1] - extremal.costate[step:-1:step]
    held = jax.vmap(slackness, in_axes=(0, 0, None, None))(
        by, extremal.x[step:-1:step], extremal.problem.state_bounds, a.size.x
    )
    gap = held / a.size.costate[None]
    rows.add("costate jumps", _costates(extremal.problem), gap, a.breaks[1:-1], tight)


def stationarity(rows: Checks, a: Along, tight: float) -> None:
    """H bar stationary in the control, and convex (Legendre-Clebsch)."""
    extremal, size, problem = a.extremal, a.size, a.extremal.problem
    if not problem.m:
        return
    t, names, slope = (
        extremal.t,
        problem.control_names,
        jax.grad(constrained_hamiltonian, argnums=3),
    )
    gap = a.at_nodes(slope) * (size.u / size.hamiltonian)[None]
    rows.add("stationarity H_u", names, gap, t, tight)
    if extremal.parametric:
        # Of node values: H_u vanishes weighted by the hat function of each node (thesis, eq. 4.33).
        inside, hat = a.at_gauss(slope), lambda sign: (1 + sign * a.gauss)[None, :, None] / 2
        before, after = (a.integrals(hat(sign) * inside) for sign in (-1, 1))
        none = jnp.zeros_like(before[:1])
        hats = jnp.concatenate([before, none]) + jnp.concatenate([none, after])
        hats = hats * (size.u / (size.hamiltonian * size.t))[None]
        rows.add("stationarity of node values", names, hats, a.breaks, tight)
    h_uu = a.at_nodes(lambda p, t, x, u, c, k: jax.hessian(hamiltonian, argnums=3)(p, t, x, u, c))
    least = h_uu[:, 0, 0] if problem.m == 1 else jnp.linalg.eigvalsh(h_uu)[:, 0]
    # Minus the least eigenvalue, so that the row passes if it is <= 0.
    worst = jnp.argmin(least)
    rows.add_signed("Legendre-Clebsch", ("-min eig H_uu",), -least[worst], t[worst], 0.0)


def bounds(rows: Checks, a: Along, tight: float) -> None:
    """Path constraints, states and controls within bounds, and the signs of their covectors. Path
    constraints and states are looked at between the nodes too; a control is flown within its
    bounds (`Extremal.__call__`)."""
    extremal, problem, t = a.extremal, a.extremal.problem, a.extremal.t
    m = extremal.multipliers
    covectors = (m.path, m.state, m.control)
    found = bound_errors(problem, t, extremal.x, extremal.u, covectors, a.size)
    paths = tuple(f"path {i}" for i in range(found.path.shape[1]))
    states, controls = problem.state_names, problem.control_names
    gauss, size = nodes_lg(2 * extremal.degree)[0], (a.size.path, a.size.x)
    t_in, x_in, u_in = a.between[:3]
    inside = oversteps_between(problem, gauss, (t_in, x_in, u_in), size)
    path, state = (jnp.concatenate(over) for over in inside)
    times = a.between[0].reshape(-1)
    both, times = lambda at, between: jnp.concatenate([at, between]), jnp.concatenate([t, times])
    rows.add("path constraints", paths, both(found.path, path), times, tight)
    rows.add("state bounds", states, both(found.state, state), times, tight)
    rows.add("control bounds", controls, found.control, t, tight)
    rows.add("complementarity", paths + states + controls, found.complementarity, t, tight)


def integrals(rows: Checks, a: Along, tight: float) -> None:
    """Integral constraints, and the signs of their covectors."""
    problem, r, tf = a.extremal.problem, a.extremal.multipliers.integral, a.extremal.t[-1]
    each = a.at_gauss(lambda p, t, x, u, c, k: p.integrands(t, x, u))
    total = lambda values: jnp.sum(a.integrals(values), axis=0)
    gained, within = total(each), problem.integral_bounds
    of = bound_size(total(jnp.abs(each)), within)
    labels = tuple(f"integral {i}" for i in range(gained.shape[0]))
    rows.add("integral constraints", labels, (overstep(gained, within) / of)[None], tf[None], tight)
    signs = slackness(r, gained, within, of) * of / a.size.cost
    rows.add("complementarity, integrals", labels, signs[None], tf[None], tight)


def static_parameters(rows: Checks, a: Along, tight: float) -> None:
    """Static parameters: the gradient of Ebar + int H bar dt vanishes, or a bound holds it."""
    problem, chosen, tf = a.extremal.problem, a.extremal.chosen, a.extremal.t[-1]
    if chosen is None:
        return

    def lagrangian(p: Array) -> Array:
        other = chosen.into(problem, p)
        ends = endpoint_lagrangian(other, a.extremal.multipliers.endpoint, *a.ends())
        return ends + jnp.sum(a.integrals(a.at_gauss(constrained_hamiltonian, other)))

    p = chosen.values(problem)
    of = bound_size(p, chosen.bounds)
    gap = slackness(-jax.grad(lagrangian)(p), p, chosen.bounds, of) * of / a.size.cost
    rows.add("static parameters", chosen.names, gap[None], tf[None], tight)


def spectral_tails(rows: Checks, a: Along, tight: float) -> None:
    """Spectral tails: the last two Legendre coefficients of each segment's polynomial."""
    problem, last = a.extremal.problem, legendre_matrix(a.extremal.reference_nodes)[-2:]
    tail = lambda parts, of: (
        jnp.max(jnp.abs(jnp.einsum("rp,spk->srk", last, parts)), axis=1) / of[None]
    )
    state, costate = tail(a.parts[1], a.size.x), tail(a.parts[3], a.size.costate)
    rows.add("spectral tail, state", problem.state_names, state, a.breaks[1:], tight)
    rows.add("spectral tail, costate", _costates(problem), costate, a.breaks[1:], tight)
