"""From the optimiser's solution to an Extremal: the covector mapping, in the user's units.

**Source:** Ross & Karpenko, review (2012), eqs (23)-(25), Proposition 1.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.conditions.angles import unwrap_angles
from jaxguide.nominal.direct import interior_point, newton
from jaxguide.nominal.direct.box import Box, boxed, distances
from jaxguide.nominal.direct.collocation import left_null
from jaxguide.nominal.direct.limits import Bounds
from jaxguide.nominal.direct.transcription import Transcription, node_times
from jaxguide.nominal.direct.unknowns import flattened
from jaxguide.problem import Problem, choices, is_free, with_parameters
from jaxguide.spectral import interpolation_matrix
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.types import RESULTS


def to_extremal(
    problem: Problem,
    program: Transcription,
    box: Bounds,
    solution: interior_point.Solution,
) -> Extremal:
    """User units; costates by the covector mapping theorem (eqs 23-25)."""
    size, rule, scale, w = program.sizes, program.rule, program.scale, solution.w
    dtype, n = program.dtype, size.n
    chosen, problem = choices(problem), with_parameters(problem, w.p * scale.p)
    support = program.support(w)
    whole = lambda a: jnp.concatenate([jnp.concatenate(a[:, :-1]), a[-1, -1:]])
    t_support = node_times(program, w, rule.support)
    t = jnp.concatenate([t_support[:, :-1].reshape(-1), t_support[-1, -1:]])
    lam, before, impulse = costates(program, box, solution)
    nodes, ends = program.derivatives(w)
    left = newton.gradient(program, nodes, ends, w, solution.y).u
    net_u = jnp.where(box.lo.u >= box.hi.u, -left, solution.zu.u - solution.zl.u)
    to_user = scale.objective / scale.x
    # Controls and multipliers live at the nodes; the ends that are none, extrapolate them.
    spread = interpolation_matrix(jnp.asarray(rule.nodes, dtype), jnp.asarray(rule.support, dtype))
    at_nodes = node_times(program, w, rule.nodes).reshape(-1)
    x_nodes = support[:, rule.first : rule.first + size.nodes].reshape(-1, n) * scale.x[None]
    own_u = w.u.reshape(-1, size.m)
    turned = unwrap_angles(
        problem, at_nodes, x_nodes[:, : problem.n], (own_u * scale.u[None])[:, : problem.m]
    )
    turned = own_u.at[:, : problem.m].set(turned / scale.u[None, : problem.m]).reshape(w.u.shape)
    u_lo, u_hi = box.lo.u[:, :1], box.hi.u[:, :1]
    turned = jnp.where(jnp.isinf(u_lo) & jnp.isinf(u_hi), turned, w.u)
    u = jnp.einsum("pk,skm->spm", spread, turned)
    u = jnp.clip(u, u_lo, u_hi)
    spans = program.clocks @ w.times
    rate = (spans[:, 1] - spans[:, 0]) / 2  # dt/dtau, scaled
    clock = rate[:, None, None] * scale.t
    weight = jnp.asarray(rule.w, dtype)[None, :, None] * clock
    # A break belongs to the segment that has it as a node: the one before it, for "lgr-right".
    ahead = lambda a: jnp.concatenate([a[0, :1], jnp.concatenate(a[:, 1:])])
    owned = ahead if rule.first else whole
    over_nodes = lambda a: owned(jnp.einsum("pk,skm->spm", spread, a / weight)) * scale.objective
    # Multipliers of state bounds live at the support points. At a segment's end a part of them may
    # be an impulse, by which the costate jumps; where that is no node, all.
    own = slice(rule.first, rule.first + size.nodes)
    weights = np.full(len(rule.support), np.inf)
    weights[own] = rule.w
    net = solution.zu.x - solution.zl.x
    net = jnp.pad(net.at[:, -1].add(-impulse), ((0, 0), (1, 0), (0, 0)))
    state = ahead(net / (jnp.asarray(weights, dtype)[None, :, None] * clock))
    state = state * (scale.objective / scale.x)[None]
    status = solution.status
    result = RESULTS.where(
        status == interior_point.CONVERGED, RESULTS.successful, RESULTS.optimiser_stopped
    )
    result = RESULTS.where(status == interior_point.INFEASIBLE, RESULTS.infeasible, result)
    finite = jnp.all(jnp.isfinite(support)) & jnp.all(jnp.isfinite(w.u))
    result = RESULTS.where(finite, result, RESULTS.optimiser_stopped)
    f, _ = program.objective_and_residual(w)
    residual = jnp.maximum(solution.error, solution.violation)
    lost = jnp.isnan(residual) | ~jnp.isfinite(f)
    result = RESULTS.where(lost, RESULTS.undefined, result)
    if not is_free(problem.final_time):
        endless = jnp.isinf(jnp.asarray(problem.final_time, dtype))
        result = RESULTS.where(endless, RESULTS.hidden_horizon, result)
    k, m, r = problem.n, problem.m, n - problem.n
    q = size.end - len(program.order) - r
    nu = solution.y.end * scale.objective / scale.end
    return Extremal(
        t=t,
        x=whole(support)[:, :k] * scale.x[None, :k],
        u=(whole(u) * scale.u[None])[:, :m],
        reference_nodes=jnp.asarray(rule.support, dtype),
        u_before=(u[:, -1] * scale.u[None])[:, :m],
        costate=whole(lam)[:, :k] * to_user[None, :k],
        costate_before=before[:, :k] * to_user[None, :k],
        final_time=w.times[1] * scale.t,
        objective=f * scale.objective,
        multipliers=Multipliers(
            nu[:q],
            over_nodes(solution.y.path) / scale.path[None],
            state[:, :k],
            (over_nodes(net_u) / scale.u[None])[:, :m],
            nu[q : q + r],
        ),
        result=result,
        residual=residual,
        degenerate=_undecided(box, solution),
        problem=problem,
        chosen=chosen,
    )


def _undecided(bounds: Bounds, solution: interior_point.Solution) -> Bool[Array, ""]:
    """Whether a bound's distance and multiplier, whose product is the barrier mu, are both small:
    within a factor of 10 of sqrt(mu), where the barrier's derivative is off by a hundredth."""
    box = Box(*map(flattened, boxed(bounds)))
    small = 10 * jnp.sqrt(solution.mu)
    weak = lambda gap, z, on: jnp.any(on & (gap < small) & (z < small))
    w, zl, zu = map(flattened, (solution.w, solution.zl, solution.zu))
    low, high = distances(box, w)
    return weak(low, zl, box.below) | weak(high, zu, box.above)


def costates(
    program: Transcription, box: Bounds, solution: interior_point.Solution
) -> tuple[Float[Array, "segment support n"], Float[Array, "segment n"], Float[Array, "segment n"]]:
    """Scaled costates at the support points and just before the end of each segment, and their
    jumps there.

    With the defect multipliers y of the Lagrangian f + y^T (A X - B F), lambda = -B^T y/w at the
    nodes (Remark 3). At a segment's start the costate is what the segment's Lagrangian gives for
    its derivative there, the closure condition; LGL and CGL solutions carry besides a multiple of
    the left null vector of D, fixed per state by both closures.
    """
    size, rule, w, y = program.sizes, program.rule, solution.w, solution.y
    dtype, n, C = program.dtype, size.n, size.nodes
    A, weights = jnp.asarray(rule.A, dtype), jnp.asarray(rule.w, dtype)
    f_part = program.node_weights(y)
    nodal = f_part[:, :, :n] / weights[None, :, None]
    nodes, ends = program.derivatives(w)
    force = jnp.einsum("sko,skoi->ski", f_part, nodes.jacobian)[:, :, :n]
    on_support = jnp.einsum("rp,srn->spn", A, y.defect)
    own = slice(rule.first, rule.first + C)
    on_support = on_support.at[:, own].add(force)
    start = on_support[:, 0]
    # At a shared end the next segment takes over, after what state bounds there contribute.
    e = jnp.concatenate([jnp.ones(1, dtype), y.end]) @ ends.jacobian
    net = (solution.zu.x - solution.zl.x)[:, -1]
    after = jnp.concatenate([start[1:], e[-n:][None]])
    before = after + net
    if len(rule.extra):
        v = jnp.asarray(left_null(program.family, program.points), dtype) / weights
        gamma = ((nodal[:, 0] - start) / v[0] + (nodal[:, -1] - before) / v[-1]) / 2
        nodal = nodal - v[None, :, None] * gamma[:, None]
    if rule.first + C == len(rule.support):
        # On a bound the costate before is what its own polynomial says; else it is continuous.
        room = jnp.minimum(w.x[:, -1] - box.lo.x[:, -1], box.hi.x[:, -1] - w.x[:, -1])
        before = jnp.where(room < 1e-6, nodal[:, -1], after)
    lam = jnp.zeros((size.segments, size.after + 1, n), dtype)
    lam = lam.at[:, own].set(nodal).at[:, 0].set(start).at[:, -1].set(before)
    return lam, before, before - after
