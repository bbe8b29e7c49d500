"""From the optimiser's solution to an Extremal: the covector mapping, in the user's units.

**Source:** Ross & Karpenko, review (2012), section 4.1: eqs (23)-(24), Proposition 1, Remark 3.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, added, put, xp
from jaxguide.conditions.angles import unwrap_angles
from jaxguide.nominal.direct import interior_point
from jaxguide.nominal.direct.box import Box, boxed, distances
from jaxguide.nominal.direct.collocation import left_null
from jaxguide.nominal.direct.limits import Limits
from jaxguide.nominal.direct.newton_system import lagrangian_gradient
from jaxguide.nominal.direct.transcription import Nodes, Transcription, node_times
from jaxguide.nominal.direct.unknowns import flattened
from jaxguide.problem import Problem, choices, is_free, with_parameters
from jaxguide.spectral.grids import evaluation
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.types import RESULTS

# Distance, in designer units, at which a state counts as on its bound. The last barrier mu leaves a
# distance mu/z: with the default's 1e-10 it is less than this if the multiplier z is above 1e-4.
_ON_BOUND = 1e-6
# Factor of sqrt(mu) below which a distance or a multiplier is small. By derivation: the relative
# error of the barrier's derivative is mu/z^2, a hundredth at this factor.
_WEAK = 10


def to_extremal(
    problem: Problem,
    program: Transcription,
    limits: Limits,
    solution: interior_point.Solution,
) -> Extremal:
    """The solution in user units, with costates by the covector mapping.

    **Source:** Ross & Karpenko, review (2012), eqs (23)-(24) and Proposition 1.
    """
    rule, scale, w = program.rule, program.scale, solution.w
    chosen = choices(problem)
    problem = with_parameters(problem, w.p * scale.p)
    n, m = problem.n, problem.m
    covectors = costates(program, limits, solution)
    spread = _spread(program)
    settled = problem if chosen is None else chosen.unsettled(problem)
    u = _controls(settled, program, limits, solution, spread)
    x = whole(program.support(w))[:, :n] * scale.x[None, :n]
    to_user = (scale.objective / scale.x)[None, :n]
    f, _ = program.objective_and_residual(w)
    residual = xp.maximum(solution.error, solution.violation)
    numbers = {
        "t": _times(program, solution),
        "x": x,
        "u": (whole(u) * scale.u[None])[:, :m],
        "reference_nodes": xp.asarray(rule.support, program.dtype),
        "u_before": (u[:, -1] * scale.u[None])[:, :m],
        "costate": whole(covectors.at_support)[:, :n] * to_user,
        "costate_before": covectors.before[:, :n] * to_user,
        "final_time": w.times[1] * scale.t,
        "objective": f * scale.objective,
        "residual": residual,
        "degenerate": _undecided(limits, solution),
    }
    return Extremal(
        **numbers,
        multipliers=_multipliers(problem, program, limits, solution, covectors.jump, spread),
        result=_result(problem, program, solution, f, residual),
        problem=problem,
        chosen=chosen,
    )


def whole(a: Float[Array, "segment support *k"]) -> Float[Array, "point *k"]:
    """Values at the support points as one sequence: a point that two segments share is the first of
    the later one."""
    return xp.concatenate([xp.concatenate(a[:, :-1]), a[-1, -1:]])


def _times(program: Transcription, solution: interior_point.Solution) -> Float[Array, " point"]:
    """Times of the support points, in user units."""
    t = node_times(program, solution.w, program.rule.support)
    return xp.concatenate([t[:, :-1].reshape(-1), t[-1, -1:]])


def _spread(program: Transcription) -> Float[Array, "support node"]:
    """From values at the nodes to the support points: ends that are no nodes are extrapolated."""
    rule, dtype = program.rule, program.dtype
    return xp.asarray(evaluation(rule.nodes, rule.support), dtype)


def _controls(
    problem: Problem,
    program: Transcription,
    limits: Limits,
    solution: interior_point.Solution,
    spread: Float[Array, "support node"],
) -> Float[Array, "segment support m"]:
    """Controls at the support points, scaled, within their bounds; unbounded angles unwrapped, so
    that they are smooth where they are extrapolated."""
    counts, rule, scale, w = program.counts, program.rule, program.scale, solution.w
    at_nodes = node_times(program, w, rule.nodes).reshape(-1)
    own = slice(rule.first, rule.first + counts.nodes)
    x_nodes = program.support(w)[:, own].reshape(-1, counts.n) * scale.x[None]
    own_u = w.u.reshape(len(at_nodes), counts.m)
    turned = unwrap_angles(
        problem, at_nodes, x_nodes[:, : problem.n], (own_u * scale.u[None])[:, : problem.m]
    )
    turned = put(own_u, np.s_[:, : problem.m], turned / scale.u[None, : problem.m])
    turned = turned.reshape(w.u.shape)
    u_lo, u_hi = limits.lo.u[:, :1], limits.hi.u[:, :1]
    turned = xp.where(xp.isinf(u_lo) & xp.isinf(u_hi), turned, w.u)
    u = xp.einsum("pk,skm->spm", spread, turned)
    return xp.clip(u, u_lo, u_hi)


def _multipliers(
    problem: Problem,
    program: Transcription,
    limits: Limits,
    solution: interior_point.Solution,
    jump: Float[Array, "segment n"],
    spread: Float[Array, "support node"],
) -> Multipliers:
    """Multipliers of all constraints, in user units; those along the trajectory as densities in
    time, the program's multipliers over weight and dt/dtau, as Proposition 1 has it of costates."""
    counts, rule, scale, w = program.counts, program.rule, program.scale, solution.w
    dtype = program.dtype
    spans = program.clocks @ w.times
    rate = (spans[:, 1] - spans[:, 0]) / 2  # dt/dtau, scaled
    clock = rate[:, None, None] * scale.t
    weight = xp.asarray(rule.w, dtype)[None, :, None] * clock
    # A break belongs to the segment that has it as a node: the one before it, for "lgr-right".
    ahead = lambda a: xp.concatenate([a[0, :1], xp.concatenate(a[:, 1:])])
    owned = ahead if rule.first else whole
    over_nodes = lambda a: owned(xp.einsum("pk,skm->spm", spread, a / weight)) * scale.objective
    # A given control has no bounds' multipliers: its own is minus the Lagrangian's gradient by it.
    nodes, ends = program.derivatives(w)
    left = lagrangian_gradient(program, nodes, ends, w, solution.y).u
    net_u = xp.where(limits.lo.u >= limits.hi.u, -left, solution.zu.u - solution.zl.u)
    # Multipliers of state bounds live at the support points. At a segment's end a part of them may
    # be an impulse, by which the costate jumps; at an end that is no node, all of them.
    weights = np.full(len(rule.support), np.inf)
    weights[rule.first : rule.first + counts.nodes] = rule.w
    net = solution.zu.x - solution.zl.x
    net = xp.pad(added(net, np.s_[:, -1], -jump), ((0, 0), (1, 0), (0, 0)))
    state = ahead(net / (xp.asarray(weights, dtype)[None, :, None] * clock))
    state = state * (scale.objective / scale.x)[None]
    n, m, r = problem.n, problem.m, counts.n - problem.n
    q = counts.end - len(program.order) - r
    nu = solution.y.end * scale.objective / scale.end
    numbers = (
        nu[:q],
        over_nodes(solution.y.path) / scale.path[None],
        state[:, :n],
        (over_nodes(net_u) / scale.u[None])[:, :m],
        nu[q : q + r],
    )
    return Multipliers(*numbers)


def _result(
    problem: Problem,
    program: Transcription,
    solution: interior_point.Solution,
    f: Float[Array, ""],
    residual: Float[Array, ""],
) -> RESULTS:
    """Why the optimiser ended, or why its numbers are of no use."""
    status, w = solution.status, solution.w
    result = chosen_result(
        status == interior_point.CONVERGED, RESULTS.successful, RESULTS.optimiser_stopped
    )
    result = chosen_result(status == interior_point.INFEASIBLE, RESULTS.infeasible, result)
    finite = xp.all(xp.isfinite(program.support(w))) & xp.all(xp.isfinite(w.u))
    result = chosen_result(finite, result, RESULTS.optimiser_stopped)
    lost = xp.isnan(residual) | ~xp.isfinite(f)
    result = chosen_result(lost, RESULTS.undefined, result)
    if not is_free(problem.final_time):
        endless = xp.isinf(xp.asarray(problem.final_time, program.dtype))
        result = chosen_result(endless, RESULTS.hidden_horizon, result)
    return result


def _undecided(limits: Limits, solution: interior_point.Solution) -> Bool[Array, ""]:
    """Whether the distance to a bound and its multiplier, whose product is the barrier mu, are both
    within a factor of `_WEAK` of sqrt(mu): there the barrier's derivative is off by a hundredth or
    more."""
    box = Box(*map(flattened, boxed(limits)))
    small = _WEAK * xp.sqrt(solution.mu)
    weak = lambda gap, z, on: xp.any(on & (gap < small) & (z < small))
    w, zl, zu = map(flattened, (solution.w, solution.zl, solution.zu))
    low, high = distances(box, w)
    return weak(low, zl, box.below) | weak(high, zu, box.above)


def chosen_result(condition: Any, yes: RESULTS, no: RESULTS) -> RESULTS:
    """`RESULTS.where`, which compiles nothing on the host."""
    if isinstance(condition, jax.Array):
        return RESULTS.where(condition, yes, no)
    return yes if condition else no


class Costates(NamedTuple):
    """Scaled costates at the support points and just before the end of each segment, and the jump
    there: the costate before less that after."""

    at_support: Float[Array, "segment support n"]
    before: Float[Array, "segment n"]
    jump: Float[Array, "segment n"]


def costates(program: Transcription, limits: Limits, solution: interior_point.Solution) -> Costates:
    """Costates lambda_i of problem B^{lambda N} from the defect multipliers y of the Lagrangian
    f + y^T (A X - B F). The Extremal interpolates between them, review, eq. (23).

    At a segment's start the costate is the derivative of the Lagrangian with respect to the state
    there (the closure condition). LGL and CGL solutions also carry a multiple of the left null
    vector of D, which both closures fix, state by state.

    **Source:** Ross & Karpenko, review (2012), eqs (23)-(24), Proposition 1 and Remark 3.
    """
    counts, rule, w, y = program.counts, program.rule, solution.w, solution.y
    dtype, n = program.dtype, counts.n
    own = slice(rule.first, rule.first + counts.nodes)
    weights = xp.asarray(rule.w, dtype)
    # Lambda = P Lambda~ with P diagonal, the reciprocals of the integration weights: review,
    # Proposition 1 and Remark 3. Here Lambda~ is -B^T y.
    f_part = program.node_weights(y)
    nodal = f_part[:, :, :n] / weights[None, :, None]
    nodes, ends = program.derivatives(w)
    start = _closure(program, solution, nodes, f_part)
    # At a shared end the next segment's costate takes over, after the multipliers of state bounds
    # there; at the last, lambda_N = dEbar/dx_N: review, eq. (24).
    e = xp.concatenate([xp.ones(1, dtype), y.end]) @ ends.jacobian
    net = (solution.zu.x - solution.zl.x)[:, -1]
    after = xp.concatenate([start[1:], e[-n:][None]])
    before = after + net
    if len(rule.extra):
        v = xp.asarray(left_null(program.family, program.points), dtype) / weights
        gamma = ((nodal[:, 0] - start) / v[0] + (nodal[:, -1] - before) / v[-1]) / 2
        nodal = nodal - v[None, :, None] * gamma[:, None]
    if own.stop == len(rule.support):
        # On a bound the costate before is that of its own polynomial; elsewhere it is continuous.
        lo, hi = limits.lo.x[:, -1], limits.hi.x[:, -1]
        room = xp.minimum(w.x[:, -1] - lo, hi - w.x[:, -1])
        before = xp.where(room < _ON_BOUND, nodal[:, -1], after)
    lam = xp.zeros((counts.segments, counts.after + 1, n), dtype)
    for at, values in ((own, nodal), (0, start), (-1, before)):
        lam = put(lam, np.s_[:, at], values)
    return Costates(lam, before, before - after)


def _closure(
    program: Transcription,
    solution: interior_point.Solution,
    nodes: Nodes,
    f_part: Float[Array, "segment node out"],
) -> Float[Array, "segment n"]:
    """Costate at the start of each segment: the derivative of the segment's Lagrangian with respect
    to the state there, as the closure condition lambda_0 = -dEbar/dx_0 of the review, eq. (24), has
    it at the first."""
    rule, y = program.rule, solution.y
    A = xp.asarray(rule.A, program.dtype)
    force = xp.einsum("sko,skoi->ski", f_part, nodes.jacobian)[:, :, : program.counts.n]
    on_support = xp.einsum("rp,srn->spn", A, y.defect)
    own = slice(rule.first, rule.first + program.counts.nodes)
    return added(on_support, np.s_[:, own], force)[:, 0]
