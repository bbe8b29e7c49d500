"""A primal-dual interior-point method for transcriptions, in fixed shapes: one program a mesh.

Newton's method on the perturbed conditions with inertia correction, a filter line search with
second-order correction, and feasibility restoration by least-distance Newton steps. The barrier
falls monotonically while the solution is far, and follows a probing step when it is near. One loop
body serves every kind of step, so that the factorisation is compiled once.

**Source:** Waechter & Biegler, Math. Program. 106 (2006); equation numbers below are theirs. The
adaptive barrier: Nocedal, Waechter & Waltz, SIAM J. Optim. 19 (2009), Mehrotra's probing heuristic.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxguide.nominal.direct import elimination, kkt, newton
from jaxguide.nominal.direct.box import (
    Box,
    Entries,
    barrier_gradient,
    barrier_value,
    boxed,
    complementarity,
    distances,
    inside,
    longest_dual_step,
    longest_step,
    total,
)
from jaxguide.nominal.direct.limits import Bounds
from jaxguide.nominal.direct.log import report
from jaxguide.nominal.direct.transcription import Ends, Nodes, Transcription
from jaxguide.nominal.direct.unknowns import Primal, Rows, flattened

_tree = jax.tree_util.tree_map

# Constants of the paper, section 3.
_KAPPA_EPS, _KAPPA_MU, _THETA_MU, _TAU_MIN = 10.0, 0.2, 1.5, 0.99
_KAPPA_SIGMA, _S_MAX = 1e10, 100.0
_GAMMA, _DELTA, _S_THETA, _S_PHI, _ETA = 1e-5, 1.0, 1.1, 2.3, 1e-4
_DELTA_FIRST, _DELTA_MAX = 1e-4, 1e12
_S_D_MAX = 1e4  # multipliers may not excuse more than this of the gradient
_HALVINGS, _FILTER = 30, 128
# The barrier is free below `_NEAR` while the error falls below `_FALL` of its worst in as many such
# iterates, and stays above `_AHEAD` of that error. Chosen by experiment: free from the start, or
# where the problem is not convex, NPSAT1 took three times the iterations.
_NEAR, _FALL, _MEMORY, _MU_MAX, _AHEAD = 1e-3, 0.9999, 4, 1e2, 1e-4
_IDLE = 1e-3  # curvature lent to free knots, lest one that nothing needs wander; best of five tried
_SHRINK = 0.5  # of the horizon, that a step may take away
_MULTIPLIERS_MAX = 1e3  # of the first estimate; a larger one is worth less than none

# Kinds of pass through the loop.
_NEWTON, _RESTORE, _ESTIMATE = 0, 1, 2
RUNNING, CONVERGED, INFEASIBLE, TOO_MANY, STALLED = 0, 1, 2, 3, 4


class Options(NamedTuple):
    """Runtime arguments: changing them compiles nothing."""

    tolerance: Any
    mu: Any
    max_iterations: Any
    push: Any  # how far from the bounds to start, relative to them and to their distance
    warm: Any  # whether the start's multipliers are to be believed


class Start(NamedTuple):
    """Where to begin: the unknowns and, from a solution nearby, multipliers of the constraints and
    net multipliers (upper less lower) of the bounds."""

    w: Primal
    y: Rows
    net: Primal


class Solution(NamedTuple):
    """Where the iterations ended."""

    w: Primal
    y: Rows
    zl: Primal
    zu: Primal
    mu: Float[Array, ""]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    error: Float[Array, ""]
    violation: Float[Array, ""]


class _Filter(NamedTuple):
    theta: Float[Array, " slot"]
    phi: Float[Array, " slot"]
    used: Int[Array, ""]


class _State(NamedTuple):
    """Unknowns and bounds' multipliers as vectors: a leaf costs as much as all of them."""

    w: Array
    y: Rows
    zl: Array
    zu: Array
    mu: Array
    filter: _Filter
    theta_max: Array
    theta_min: Array
    theta_entry: Array  # violation at which restoration began
    delta: Array  # last regularisation that was needed
    mode: Array
    k: Array
    status: Array
    error: Array
    free: Array  # bool: the barrier followed a probe; else it is held until its problem is solved
    errors: Array  # at the last iterates of the free kind


def _largest(tree: Any) -> Array:
    leaves = [jnp.max(jnp.abs(a), initial=0.0) for a in jax.tree_util.tree_leaves(tree)]
    return jnp.max(jnp.stack(leaves))


def _finite(tree: Any) -> Array:
    return jnp.isfinite(total(_tree(jnp.abs, tree)))


def _norm1(c: Rows) -> Array:
    return total(_tree(jnp.abs, c))


def _count(tree: Any) -> int:
    return sum(a.size for a in jax.tree_util.tree_leaves(tree))


def _where(condition: Array, a: Any, b: Any) -> Any:
    return _tree(lambda x, y: jnp.where(condition, x, y), a, b)


def _move(a: Any, alpha: Array, d: Any) -> Any:
    return _tree(lambda x, y: x + alpha * y, a, d)


def _acceptable(filter: _Filter, theta: Array, phi: Array) -> Array:
    """Whether (theta, phi) is not dominated by the filter (eq. 18)."""
    better = (theta < filter.theta) | (phi < filter.phi)
    live = jnp.arange(_FILTER, dtype=filter.used.dtype) < filter.used
    return jnp.all(better | ~live)


def _augment(filter: _Filter, theta: Array, phi: Array, add: Array) -> _Filter:
    at = filter.used % _FILTER
    new = _Filter(
        filter.theta.at[at].set((1 - _GAMMA) * theta),
        filter.phi.at[at].set(phi - _GAMMA * theta),
        filter.used + 1,
    )
    return _where(add, new, filter)


def optimality_error(
    box: Box, gradient: Entries, w: Entries, y: Rows, zl: Entries, zu: Entries, c: Rows
) -> Callable[[Array], Array]:
    """mu -> E_mu of eq. (5): the worst scaled violation of the perturbed conditions. `gradient`:
    of the Lagrangian without its bounds."""
    net = _tree(lambda g, a, b: g - a + b, gradient, zl, zu)
    net = _tree(lambda g, given: jnp.where(given, 0.0, g), net, box.given)
    low, high = distances(box, w)
    z = total(zl) + total(zu)
    duals = total(_tree(jnp.abs, y)) + z
    s_d = jnp.maximum(_S_MAX, duals / (_count(y) + 2 * _count(w))) / _S_MAX
    s_d = jnp.minimum(s_d, _S_D_MAX)
    s_c = jnp.maximum(_S_MAX, z / (2 * _count(w))) / _S_MAX
    smooth = jnp.maximum(_largest(net) / s_d, _largest(c))

    def error(mu: Array) -> Array:
        short = lambda a, z, on: jnp.where(on, a * z - mu, 0.0)
        below = _largest(_tree(short, low, zl, box.below))
        above = _largest(_tree(short, high, zu, box.above))
        return jnp.maximum(smooth, jnp.maximum(below, above) / s_c)

    return error


def minimise(program: Transcription, bounds: Bounds, start: Start, options: Options) -> Solution:
    """Iterates from `start` to a point that meets the first-order conditions, or says why not.

    Contradictory bounds, and a horizon that cannot be positive, are infeasible at once.
    """
    impossible = jnp.any(flattened(bounds.lo) > flattened(bounds.hi))
    impossible = impossible | (bounds.hi.times[1] <= bounds.lo.times[0])
    box = Box(*map(flattened, boxed(bounds)))
    dtype = program.dtype
    w, net = inside(box, flattened(start.w), options.push), flattened(start.net)
    mu = jnp.asarray(options.mu, dtype)
    low, high = distances(box, w)
    held = lambda a, z, on: jnp.where(on, jnp.maximum(mu / a, z), 0.0)
    zl, zu = held(low, -net, box.below), held(high, net, box.above)
    _, c = program.objective_and_residual(program.shaped(w))
    theta = _norm1(c)
    zero, nought = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    mode = jnp.where(options.warm, _NEWTON, _ESTIMATE).astype(jnp.int32)
    slots = jnp.full(_FILTER, -jnp.inf, dtype)
    state = _State(
        w, start.y, zl, zu, mu,
        _Filter(slots, slots, nought),
        1e4 * jnp.maximum(1.0, theta), 1e-4 * jnp.maximum(1.0, theta), theta,
        zero, mode, nought, jnp.where(impossible, nought + INFEASIBLE, RUNNING), zero + jnp.inf,
        jnp.array(False), jnp.full(_MEMORY, jnp.inf, dtype),
    )  # fmt: skip
    body = lambda s: _pass(program, box, options, s)
    end = jax.lax.while_loop(lambda s: s.status == RUNNING, body, state)
    w, zl, zu = (program.shaped(a) for a in (end.w, end.zl, end.zu))
    _, c = program.objective_and_residual(w)
    return Solution(w, end.y, zl, zu, end.mu, end.status, end.k, end.error, _largest(c))


def _pass(program: Transcription, box: Box, options: Options, s: _State) -> _State:
    """One step of any kind, unless none is needed any more."""
    at = _evaluated(program, box, s)
    now = at.error(jnp.zeros_like(s.mu))
    done = (s.mode == _NEWTON) & (now <= options.tolerance)
    ended = s._replace(status=s.status * 0 + CONVERGED, k=s.k + 1, error=now)
    none = jnp.zeros_like(s.mu)
    new, delta, alpha = jax.lax.cond(
        done, lambda: (ended, none, none), lambda: _step(program, box, options, s, at, now)
    )
    if program.log:
        numbers = (s.k, at.f, _largest(at.c), now, new.mu, delta, alpha)
        jax.debug.callback(report, s.mode, program.scale.objective, *numbers)
    return new


class _Move(NamedTuple):
    """A `newton.Step`, its change of the unknowns as one vector."""

    primal: Array
    dual: Rows


class _Here(NamedTuple):
    """What is known of an iterate before anything is factorised."""

    nodes: Nodes
    ends: Ends
    f: Array
    c: Rows
    low: Array
    high: Array
    error: Callable[[Array], Array]


def _evaluated(program: Transcription, box: Box, s: _State) -> _Here:
    w = program.shaped(s.w)
    nodes, ends = program.derivatives(w)
    f, c = program.objective_and_residual(w, (nodes.value, ends.value))
    lagrangian = flattened(newton.gradient(program, nodes, ends, w, s.y))
    error = optimality_error(box, lagrangian, s.w, s.y, s.zl, s.zu, c)
    low, high = distances(box, s.w)
    return _Here(nodes, ends, f, c, low, high, error)


def _patient(program: Transcription, w: Array, d: Array) -> Array:
    """The longest step by which the horizon loses no more than `_SHRINK` of itself: a model that is
    linear in time would throw most of it away, from guesses that stand still."""
    now, more = (program.shaped(a).times for a in (w, d))
    horizon, change = now[1] - now[0], more[1] - more[0]
    shrinks = (change < 0) & (horizon > 0)
    return jnp.minimum(1.0, jnp.where(shrinks, -_SHRINK * horizon / change, 1.0))


def _step(
    program: Transcription, box: Box, options: Options, s: _State, at: _Here, error_now: Array
) -> tuple[_State, Array, Array]:
    """A step of the kind `s.mode`; its regularisation and length."""
    regularly, restore, estimate = (s.mode == kind for kind in (_NEWTON, _RESTORE, _ESTIMATE))
    nodes, ends, f, c, low, high, error = at
    gap = complementarity(box, low, high, s.zl, s.zu)

    # The system of this kind of step: Newton's; nearest to feasible; multipliers alone.
    flat = restore | estimate
    w_now = program.shaped(s.w)
    hessians = program.hessians(w_now, s.y)
    hessians = _where(flat, _tree(jnp.zeros_like, hessians), hessians)
    zeros = jnp.zeros_like(s.w)
    on = {name: name in ("path", "end") for name in Primal._fields}
    slacks = flattened(Primal(*(jnp.full_like(getattr(w_now, k), on[k]) for k in on)))
    sigma = program.shaped(jnp.where(estimate, slacks, s.zl / low + s.zu / high))
    sigma = sigma._replace(times=sigma.times.at[2:].add(_IDLE))
    at_nodes, at_ends = hessians
    system = newton.System(nodes, ends, at_nodes, at_ends, sigma, program.shaped(box.given))
    gradient = flattened(newton.gradient(program, nodes, ends, w_now, _tree(jnp.zeros_like, s.y)))
    segments = elimination.eliminate(program, system)
    rho = 1e2 * (1 + _largest(hessians))

    # Regularised until the inertia is right (algorithm IC).
    first = jnp.where(estimate, 1.0, jnp.where(restore, jnp.sqrt(s.mu), 0.0))

    def attempt(carry: tuple) -> tuple:
        delta, _, _ = carry
        factor, ok = kkt.factorise(program, system, segments, delta, rho)
        again = jnp.where(s.delta > 0, jnp.maximum(1e-20, s.delta / 3), _DELTA_FIRST)
        grow = jnp.where(s.delta > 0, 8.0, 100.0)
        following = jnp.where(delta > first, delta * grow, jnp.maximum(again, 8 * delta))
        return jnp.where(ok, delta, following), factor, ok

    blank = jax.eval_shape(lambda d: kkt.factorise(program, system, segments, d, rho)[0], first)
    blank = _tree(lambda a: jnp.zeros(a.shape, a.dtype), blank)
    delta, factor, regular = jax.lax.while_loop(
        lambda a: ~a[2] & (a[0] < _DELTA_MAX), attempt, (first, blank, jnp.array(False))
    )
    delta_last = jnp.where(regular & ~flat & (delta > 0), delta, s.delta)

    # Barrier: free to follow a probe near a convex solution while the error falls; else held at the
    # complementarity found and lowered when its problem is solved to its own size (eq. 7).
    least = options.tolerance / 10
    falls = error_now <= _FALL * jnp.max(s.errors)
    free = regularly & (delta == 0) & falls & (s.mu <= _NEAR)
    errors = jnp.where(free, jnp.roll(s.errors, 1).at[0].set(error_now), s.errors)
    held = jnp.where(regularly & s.free & ~free, jnp.maximum(least, 0.8 * gap), s.mu)
    lower = lambda mu: jnp.maximum(least, jnp.minimum(_KAPPA_MU * mu, mu**_THETA_MU))
    ready = lambda mu: regularly & ~free & (error(mu) <= _KAPPA_EPS * mu) & (mu > least)
    mu = jax.lax.while_loop(ready, lower, held)
    tau = jnp.maximum(_TAU_MIN, 1 - jnp.where(free, error_now, mu))
    # What was refused under another barrier says nothing of this one.
    filter_of = lambda mu: s.filter._replace(used=jnp.where(mu != s.mu, 0, s.filter.used))

    pull = barrier_gradient(box, low, high, jnp.ones_like(s.mu))
    bare = gradient - s.zl + s.zu
    was = _where(flat, _tree(jnp.zeros_like, s.y), s.y)

    def load(c: Rows, mu: Array) -> newton.Load:
        with_barrier = jnp.where(restore, 0.0, gradient) + mu * pull
        rows = c._replace(path=c.path + newton.COMPLIANCE * was.path)
        return newton.Load(program.shaped(jnp.where(estimate, bare, with_barrier)), rows)

    # Changes of the bounds' multipliers with a step.
    rate = lambda mu, z, a, dw, on, sign: jnp.where(on, mu / a - z - sign * z / a * dw, 0.0)

    def duals(mu: Array, d: Array) -> tuple[Array, Array]:
        lower = rate(mu, s.zl, low, d, box.below, 1.0)
        return lower, rate(mu, s.zu, high, d, box.above, -1.0)

    def probed(step: _Move) -> Array:
        """Mehrotra's rule: the barrier falls as much as the step without one would make it."""
        one = jnp.ones_like(mu)
        dzl, dzu = duals(jnp.zeros_like(mu), step.primal)
        alpha = longest_step(low, high, step.primal, box, one)
        alpha_z = jnp.minimum(longest_dual_step(s.zl, dzl, one), longest_dual_step(s.zu, dzu, one))
        low_, high_ = distances(box, _move(s.w, alpha, step.primal))
        zl, zu = _move(s.zl, alpha_z, dzl), _move(s.zu, alpha_z, dzu)
        left = complementarity(box, low_, high_, zl, zu) / jnp.where(gap > 0, gap, 1.0)
        # It may not run ahead of the other conditions.
        floor = jnp.minimum(s.mu, jnp.minimum(_AHEAD * error_now, error_now**_THETA_MU))
        return jnp.clip(gap * left**3, jnp.maximum(least, floor), _MU_MAX)

    # The filter line search: the full step, then its second-order correction, then halves.
    theta, logs = _norm1(c), barrier_value(box, s.w, jnp.ones_like(mu))

    def slope_of(mu: Array, d: Array) -> Array:
        return jnp.dot(gradient + mu * pull, d)

    def judge(
        mu: Array, alpha: Array, slope: Array, d: Array, length: Array
    ) -> tuple[Array, Array, Rows, Array]:
        """Whether a move by `length` d is acceptable as a step of size `alpha`."""
        phi = f + mu * logs
        slack = 1e2 * jnp.finfo(phi.dtype).eps * (1 + jnp.abs(phi))
        steep = jnp.where(slope < 0, -slope, 0.0)
        w = _move(s.w, length, d)
        f_new, c = program.objective_and_residual(program.shaped(w))
        theta_new, phi_new = _norm1(c), f_new + barrier_value(box, w, mu)
        sane = jnp.isfinite(theta_new) & jnp.isfinite(phi_new) & (theta_new <= s.theta_max)
        switch = alpha * steep**_S_PHI > _DELTA * theta**_S_THETA
        f_type = (slope < 0) & switch & (theta <= s.theta_min)
        armijo = phi_new <= phi + _ETA * alpha * slope + slack
        progress = (theta_new <= (1 - _GAMMA) * theta) | (phi_new <= phi - _GAMMA * theta + slack)
        good = jnp.where(f_type, armijo, progress)
        good = good & _acceptable(filter_of(mu), theta_new, phi_new - slack)
        nearer = theta_new <= (1 - 1e-4 * alpha) * theta
        return sane & jnp.where(restore, nearer, good), f_type & armijo, c, theta_new

    def aim(carry: tuple) -> tuple:
        """The step towards `target`, and whether all of it is acceptable; once more, corrected.
        Before, where the barrier is free, a step without one."""
        k, mu, target, first, _, _, _, _ = carry
        probe = k < 0
        right = load(target, jnp.where(probe, 0.0, mu))
        solved = kkt.solve(program, system, segments, factor, right)
        step = _Move(flattened(solved.primal), solved.dual)
        length = jnp.minimum(
            longest_step(low, high, step.primal, box, tau), _patient(program, s.w, step.primal)
        )
        first = _where(k == 0, (step, length), first)
        ok, f_type, c_new, theta_new = judge(
            mu, first[1], slope_of(mu, first[0].primal), step.primal, length
        )
        ok = ok & _finite(step) & ~probe
        mu = jnp.where(probe & regular & _finite(step), probed(step), mu)
        worse = (theta_new >= theta) & jnp.isfinite(theta_new)
        again = probe | ((k == 0) & regularly & regular & ~ok & worse)
        corrected = _tree(lambda a, b: length * a + b, c, c_new)
        target = _where(probe, target, corrected)
        return k + 1, mu, target, first, (step, length), ok, f_type, again

    target = _where(estimate, _tree(jnp.zeros_like, c), c)
    none = (_Move(zeros, _tree(jnp.zeros_like, s.y)), jnp.ones_like(s.mu))
    no, yes = jnp.array(False), jnp.array(True)
    _, mu, _, (step, longest), latest, full, f_type, _ = jax.lax.while_loop(
        lambda a: a[-1], aim, (jnp.where(free, -1, 0), mu, target, none, none, no, no, yes)
    )
    regular, filter = regular & _finite(step), filter_of(mu)
    slope = slope_of(mu, step.primal)

    def shorten(carry: tuple) -> tuple:
        alpha, _, _, k = carry
        ok, f_type, _, _ = judge(mu, alpha / 2, slope, step.primal, alpha / 2)
        return alpha / 2, ok, f_type, k + 1

    alpha, found, f_type, _ = jax.lax.while_loop(
        lambda a: ~a[1] & (a[3] < _HALVINGS),
        shorten,
        (longest, full | estimate | ~regular, f_type, 0),
    )
    accepted = regular & found & ~estimate
    moved, alpha = _where(full, latest, (step, alpha))
    d = moved.primal

    # Move.
    dzl, dzu = duals(mu, d)
    alpha_z = jnp.minimum(longest_dual_step(s.zl, dzl, tau), longest_dual_step(s.zu, dzu, tau))
    w = _move(s.w, alpha, d)
    low, high = distances(box, w)
    keep = lambda z, a, on: jnp.where(
        on, jnp.clip(z, mu / (_KAPPA_SIGMA * a), _KAPPA_SIGMA * mu / a), 0.0
    )
    zl = keep(s.zl + alpha_z * dzl, low, box.below)
    zu = keep(s.zu + alpha_z * dzu, high, box.above)
    y = _tree(lambda a, b: a + alpha * (b - a), s.y, moved.dual)
    modest = regular & (_largest(step.dual) <= _MULTIPLIERS_MAX)
    estimated = _where(modest, step.dual, _tree(jnp.zeros_like, s.y))
    new_w = _where(accepted, w, s.w)
    new_y = _where(estimate, estimated, _where(accepted & ~restore, y, s.y))
    new_zl, new_zu = _where(accepted, (zl, zu), (s.zl, s.zu))

    # What comes next.
    evaluate = lambda: program.objective_and_residual(program.shaped(new_w))
    f_at, c_at = jax.lax.cond(restore, evaluate, lambda: (f, c))  # asked after restoration alone
    theta_at = _norm1(c_at)
    phi_at = f_at + barrier_value(box, new_w, mu)
    home = (theta_at <= 0.9 * s.theta_entry) & _acceptable(filter, theta_at, phi_at)
    home = accepted & restore & (home | (_largest(c_at) <= options.tolerance / 10))
    failed = ~accepted & ~estimate
    into, stuck = failed & regularly, failed & restore
    feasible = _largest(c) <= jnp.maximum(1e-8, options.tolerance)
    mode = jnp.where((restore & ~home) | into, _RESTORE, _NEWTON)
    mode = jnp.where(home, _ESTIMATE, mode)
    filter = _augment(filter, theta, f + mu * logs, (accepted & regularly & ~f_type) | into)
    status = jnp.where(stuck, jnp.where(feasible, STALLED, INFEASIBLE), RUNNING)
    status = jnp.where(into & feasible, STALLED, status)
    status = jnp.where((s.k + 1 >= options.max_iterations) & (status == RUNNING), TOO_MANY, status)
    new = _State(
        new_w, new_y, new_zl, new_zu, mu, filter, s.theta_max, s.theta_min,
        jnp.where(into, theta, s.theta_entry), delta_last, mode.astype(s.mode.dtype),
        s.k + 1, status.astype(s.status.dtype), error_now, free, errors,
    )  # fmt: skip
    return new, delta, jnp.where(accepted, alpha, 0.0)
