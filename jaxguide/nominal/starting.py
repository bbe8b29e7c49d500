"""Where a direct solve starts: designer units, and guesses straight, random or from an extremal,
multipliers included."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.linalg import solve as small_solve
from jaxguide.nominal.transcription import Primal, Rows, Scale, Transcription, ordered
from jaxguide.nominal.wrappers import evened
from jaxguide.problem import (
    Problem,
    bounds_of,
    count,
    endpoint_count,
    initial_values,
    initially_free,
    is_free,
    parameters,
    start_control,
    start_value,
    with_parameters,
)
from jaxguide.trajectory import Extremal

_REST = 1e-8  # a guess below it rests at zero
_FAR = 3  # orders of magnitude from 1 at which a size is not left at 1
_SHARES = (0.0, -0.25, 0.25)  # of a control's range, from its middle


def edges(fractions: Float[Array, " edge"], knots: tuple[int, ...]) -> Float[Array, "edge clock"]:
    """Break points as combinations of (t0, tf, knots): each between the two nearest of them."""
    last = fractions.shape[0] - 1
    main = np.array([0, *sorted(knots), last])
    column = np.array([0, *range(2, 2 + len(knots)), 1])
    j = np.arange(last + 1)
    left = np.clip(np.searchsorted(main, j, side="right") - 1, 0, len(main) - 2)
    a, b = fractions[main[left]], fractions[main[left + 1]]
    share = (fractions - a) / (b - a)
    out = jnp.zeros((last + 1, 2 + len(knots)), fractions.dtype)
    return out.at[j, column[left]].add(1 - share).at[j, column[left + 1]].add(share)


def unit_scale(problem: Problem, knots: int) -> Scale:
    path, end = count(problem, "path_constraints"), endpoint_count(problem)
    end += len(ordered(problem, 2 + knots))
    one = jnp.ones((), jnp.result_type(float))
    many = lambda k: jnp.ones(k, one.dtype)
    return Scale(
        many(problem.n), many(problem.m), one, many(len(parameters(problem))), many(path),
        many(end), one,
    )  # fmt: skip


def horizon_guess(problem: Problem) -> tuple[Array, Array]:
    """Times to start from: given, guessed, or one unit where nothing is said."""
    dtype = jnp.result_type(float)
    number = lambda v: jnp.asarray(v, dtype)
    start, end = problem.initial_time, problem.final_time
    t0 = number(start_value(start))
    if not is_free(end) or end.guess is not None:
        tf = number(start_value(end))
    else:
        lo, hi = number(end.lo), number(end.hi)
        bounded = jnp.isfinite(lo) & jnp.isfinite(hi)
        tf = jnp.where(bounded, start_value(end), jnp.clip(t0 + 1.0, lo, hi))
    # What nobody gave makes way.
    halfway = lambda a, b, other: jnp.where(jnp.isfinite(b), (a + b) / 2, other)
    if is_free(end) and end.guess is None:
        tf = jnp.where(tf > t0, tf, halfway(t0, number(end.hi), t0 + 1.0))
    if is_free(start) and start.guess is None:
        t0 = jnp.where(tf > t0, t0, halfway(tf, number(start.lo), tf - 1.0))
    return t0, tf


def straight_guess(
    program: Transcription, fractions: Float[Array, " edge"], knots: tuple[int, ...]
) -> Primal:
    """States on a straight line to the nearest ends that meet the endpoint constraints; controls
    in the middle of their bounds. In user units."""
    problem, size = with_parameters(program.problem, None), program.sizes
    dtype, n = program.dtype, size.n
    lo, hi = bounds_of(program.problem.state_bounds, n, dtype)
    x0 = jnp.clip(initial_values(program.problem, dtype), lo, hi)
    t0, tf = horizon_guess(program.problem)
    q = size.end - len(program.order)
    e_lo, e_hi = bounds_of(program.problem.endpoint_bounds, q, dtype)
    said = _said(lo, hi, x0[None])
    scale = jnp.tile(jnp.where(said > 0, said, 1.0), 2)
    # Free components of the initial state move with the final ones.
    free = jnp.concatenate([jnp.asarray(initially_free(program.problem)), jnp.ones(n, bool)])
    scale = jnp.where(free, scale, 0.0)
    low, high = jnp.tile(lo, 2), jnp.tile(hi, 2)

    def nearer(_: Any, ends: Array) -> Array:
        def at(y: Array) -> Array:
            moved = ends + y * scale
            return problem.endpoint_constraints(moved[:n], moved[n:], t0, tf)

        e, J = at(jnp.zeros_like(ends)), jax.jacfwd(at)(jnp.zeros_like(ends))
        # By rows of one size, lest the ridge drown those of small units.
        size = jnp.linalg.norm(J, axis=1)
        size = jnp.where(size > 0, size, 1.0)
        miss, J = (e - jnp.clip(e, e_lo, e_hi)) / size, J / size[:, None]
        step = J.T @ small_solve(J @ J.T + 1e-8 * q * jnp.eye(q, dtype=dtype), miss)
        step = jnp.where(jnp.isfinite(step), step, 0.0)
        return jnp.where(free, jnp.clip(ends - scale * step, low, high), ends)

    ends = jnp.tile(x0, 2)
    ends = jax.lax.fori_loop(0, 8, nearer, ends) if q else ends
    x0, xf = ends[:n], ends[n:]
    u = start_control(program.problem, dtype)
    s = fractions_at(fractions, program.rule.support[1:])
    x = x0[None, None] + s[:, :, None] * (xf - x0)[None, None]
    over = lambda u: jnp.broadcast_to(u, (size.segments, size.nodes, size.m))
    p = [start_value(v) for v in parameters(program.problem)]
    times = placed(t0, tf, fractions, knots)
    straight = without_slacks(program, x0, x, over(u), times, p)
    u_bounds = bounds_of(problem.control_bounds, size.m, dtype)
    unbounded, middle = jnp.isinf(jnp.stack(u_bounds)).any(axis=0), jnp.clip(0.0, *u_bounds)
    u = jnp.where(unbounded, middle + (u - middle) * natural_units(program.problem, straight)[1], u)
    ends_at = lambda xf: problem.endpoint_constraints(x0, xf, t0, tf)
    unasked = ~jnp.any(jax.jacfwd(ends_at)(xf) != 0, axis=0) if q else jnp.ones(n, bool)
    rests = unasked & (jnp.abs(x0) < _REST) & (jnp.abs(xf) < _REST)
    rests = rests & ~jnp.asarray(initially_free(program.problem))
    return propagated(program, straight._replace(u=over(u)), rests)


def propagated(program: Transcription, w: Primal, rests: Bool[Array, " n"]) -> Primal:
    """`w` with the states that rest at zero, and are asked nothing at the end, flown along it.

    Where a start is singular at rest (a brachistochrone's, without speed), the middle control may
    leave them there: of three constant controls the one that fits the other states' rates best.
    """
    problem, size, dtype = with_parameters(program.problem, None), program.sizes, program.dtype
    lo, hi = bounds_of(problem.control_bounds, size.m, dtype)
    width = jnp.where(jnp.isfinite(lo) & jnp.isfinite(hi), hi - lo, 0.0)
    spans = program.clocks @ w.times
    h, middle = (spans[:, 1] - spans[:, 0])[:, None], (spans[:, 0] + spans[:, 1]) / 2
    ends = jnp.concatenate([w.x0[None], w.x[:, -1]])
    across, halfway = jnp.diff(ends, axis=0), (ends[1:] + ends[:-1]) / 2
    rate = jax.jit(jax.vmap(problem.dynamics))  # traced once

    def flown(share: Array) -> tuple[Array, Array]:
        """What each segment adds to the states, and how ill that fits the others."""
        u = w.u[:, 0] + share * width[None]
        gained = h * rate(middle, halfway, u)
        gained = jnp.where(rests[None] & jnp.isfinite(gained), gained, 0.0)
        left = h * rate(middle, halfway + jnp.cumsum(gained, axis=0) - gained / 2, u) - across
        return gained, jnp.sum(jnp.where(rests[None], 0.0, jnp.abs(left)))

    shares = jnp.asarray(_SHARES, dtype)
    tries, misfit = jax.vmap(flown)(shares)
    misfit = jnp.where(jnp.isfinite(misfit), misfit, jnp.inf)
    best = jnp.argmin(misfit * (1 + jnp.abs(shares)))  # the middle if alike
    gained, share = tries[best], jnp.where(jnp.any(rests), shares[best], 0.0)
    along = jnp.asarray((program.rule.support[1:] + 1) / 2, dtype)
    start = jnp.cumsum(gained, axis=0) - gained
    more = start[:, None] + along[None, :, None] * gained[:, None]
    x_lo, x_hi = bounds_of(problem.state_bounds, size.n, dtype)
    x = jnp.where(rests[None, None], jnp.clip(w.x + more, x_lo[None, None], x_hi[None, None]), w.x)
    return w._replace(x=x, u=w.u + (share * width)[None, None])


def random_guess(
    program: Transcription, fractions: Float[Array, " edge"], knots: tuple[int, ...], key: Array
) -> Primal:
    """The straight guess, bent at random: states by two sine waves of a third of their size within
    their bounds, controls on a line between two points of theirs, a free final time within a factor
    of two. In user units."""
    w = straight_guess(program, fractions, knots)
    size, dtype, rule = program.sizes, program.dtype, program.rule
    k_x, k_u, k_t = jax.random.split(key, 3)
    lo, hi = bounds_of(program.problem.state_bounds, size.n, dtype)
    of_x, of_u = natural_units(program.problem, w)
    waves = jax.random.normal(k_x, (2, size.n), dtype) * of_x[None] / 3
    s = fractions_at(fractions, rule.support[1:])
    bent = sum(jnp.sin((k + 1) * jnp.pi * s)[..., None] * waves[k][None, None] for k in range(2))
    x = jnp.clip(w.x + bent, lo[None, None], hi[None, None])
    u_lo, u_hi = bounds_of(program.problem.control_bounds, size.m, dtype)
    bounded = jnp.isfinite(u_lo) & jnp.isfinite(u_hi)
    middle = jnp.where(bounded, (u_lo + u_hi) / 2, 0.0)
    half = jnp.where(bounded, (u_hi - u_lo) / 2, 3.0 * of_u)
    ends = middle[None] + half[None] * jax.random.uniform(k_u, (2, size.m), dtype, -1.0, 1.0)
    ends = jnp.clip(ends, u_lo[None], u_hi[None])
    s = fractions_at(fractions, rule.nodes)[..., None]
    u = ends[0][None, None] * (1 - s) + ends[1][None, None] * s
    tf = program.problem.final_time
    times = w.times
    if is_free(tf):
        span = (times[1] - times[0]) * 2 ** jax.random.uniform(k_t, (), dtype, -1.0, 1.0)
        end = jnp.clip(times[0] + span, jnp.asarray(tf.lo, dtype), jnp.asarray(tf.hi, dtype))
        times = placed(times[0], end, fractions, knots)
    return w._replace(x=x, u=u, times=times)


def placed(t0: Array, tf: Array, fractions: Array, knots: tuple[int, ...]) -> Float[Array, " k"]:
    """t0, tf and the knots, at their fractions of the horizon."""
    inner = t0 + (tf - t0) * fractions[np.array(sorted(knots), int)]
    return jnp.concatenate([jnp.stack([t0, tf]), inner])


def without_slacks(
    program: Transcription, x0: Array, x: Array, u: Array, times: Array, p: list
) -> Primal:
    """A guess whose slacks are yet to be filled in."""
    size, dtype = program.sizes, program.dtype
    p_ = jnp.stack([jnp.asarray(v, dtype) for v in p]) if p else jnp.zeros(0, dtype)
    path = jnp.zeros((size.segments, size.nodes, size.path), dtype)
    return Primal(x0, x, u, times, p_, path, jnp.zeros(size.end, dtype))


def fractions_at(fractions: Float[Array, " edge"], tau: np.ndarray) -> Float[Array, "segment k"]:
    """Where in the horizon the points `tau` of every segment are."""
    local = jnp.asarray((tau[None] + 1) / 2, fractions.dtype)
    return fractions[:-1, None] + jnp.diff(fractions)[:, None] * local


def from_extremal(
    program: Transcription,
    fractions: Float[Array, " edge"],
    knots: tuple[int, ...],
    problem: Problem,
    guess: Extremal,
) -> Primal:
    """States and controls of `guess` at this mesh's times. In user units."""
    size, rule, dtype = program.sizes, program.rule, program.dtype
    t0, tf = guess.t[0], guess.t[-1]
    at = lambda tau: t0 + (tf - t0) * fractions_at(fractions, tau)
    fill = lambda y, k: jnp.concatenate(
        [y, jnp.zeros((*y.shape[:-1], k - y.shape[-1]), dtype)], axis=-1
    )
    point = jax.vmap(jax.vmap(guess.point))
    x = fill(point(at(rule.support[1:])).x, size.n)
    u = fill(point(at(rule.nodes)).u, size.m)
    p = [start_value(v) for v in parameters(guess.problem, like=problem)]
    times = placed(t0, tf, fractions, knots)
    return without_slacks(program, fill(guess.x[0], size.n), x, u, times, p)


def blank_duals(program: Transcription, w: Primal) -> tuple[Rows, Primal]:
    """No multipliers."""
    size = program.sizes
    defect = jnp.zeros((size.segments, program.rule.A.shape[0], size.n), program.dtype)
    zeros = jax.tree_util.tree_map(jnp.zeros_like, w)
    return Rows(defect, zeros.path, zeros.end), zeros


def fits(program: Transcription, guess: Extremal) -> bool:
    """Whether the covectors of `guess` are those of this problem's constraints."""
    size, m = program.sizes, guess.multipliers
    ends = m.endpoint.shape[0] + m.integral.shape[0]
    return (
        guess.costate.shape[1] + m.integral.shape[0] == size.n
        and ends == size.end - len(program.order)
        and m.path.shape[1] == size.path
    )


def duals(
    program: Transcription, fractions: Float[Array, " edge"], w: Primal, guess: Extremal
) -> dict[str, Any]:
    """`costates` and the multipliers of `to_extremal` undone: those of `guess` on this mesh."""
    size, rule, scale, dtype = program.sizes, program.rule, program.scale, program.dtype
    t0, tf = guess.t[0], guess.t[-1]
    times = t0 + (tf - t0) * fractions_at(fractions, np.append(rule.nodes, 1.0))
    m, r = guess.multipliers, guess.multipliers.integral
    costate = jax.vmap(jax.vmap(guess.point))(times).costate
    # An integral's costate is its multiplier, all along.
    constant = jnp.broadcast_to(r, (*costate.shape[:2], r.shape[0]))
    lam = jnp.concatenate([costate, constant], axis=2) * (scale.x / scale.objective)[None, None]
    weight = jnp.asarray(rule.w, dtype)[None, :, None]
    nodal, end = lam[:, :-1], lam[:, -1:]
    defect = -weight * nodal
    if rule.A.shape[0] > size.nodes:  # LG: the last row is the quadrature to the end
        defect = jnp.concatenate([-weight * (nodal - end), -end], axis=1)
    spans = program.clocks @ w.times
    clock = weight * ((spans[:, 1] - spans[:, 0]) / 2)[:, None, None] * scale.t / scale.objective
    held = jnp.concatenate([m.path, m.state, m.control], axis=1)
    held = jax.vmap(jax.vmap(lambda t: guess.interpolate(held, t)))(times[:, :-1])
    path, state, control = jnp.split(held, np.cumsum([m.path.shape[1], m.state.shape[1]]), axis=2)
    wide = lambda a, k: jnp.pad(a, ((0, 0), (0, 0), (0, k - a.shape[2])))
    path = path * clock * scale.path[None, None]
    end = jnp.concatenate([m.endpoint, r]) / scale.objective
    end = jnp.pad(end, (0, size.end - end.shape[0])) * scale.end
    on_states = jnp.zeros_like(w.x)
    first = 1 - rule.first  # of the nodes, the first that follows the segment's start
    state = wide(state, size.n) * clock * scale.x[None, None]
    on_states = on_states.at[:, : size.nodes - first].set(state[:, first:])
    zeros = jax.tree_util.tree_map(jnp.zeros_like, w)
    net = zeros._replace(
        x=on_states, u=wide(control, size.m) * clock * scale.u[None, None], path=path, end=end
    )
    return {"y": Rows(defect, path, end), "net": net}


def _said(lo: Array, hi: Array, seen: Float[Array, "k n"]) -> Float[Array, " n"]:
    """The larger finite bound; else the largest value seen, unless it is at rest; else 0."""
    bounded = jnp.isfinite(lo) & jnp.isfinite(hi)
    wide = jnp.where(bounded, jnp.maximum(jnp.abs(lo), jnp.abs(hi)), 0.0)
    largest = jnp.max(jnp.abs(seen), axis=0)
    return jnp.where(wide > 0, wide, jnp.where(largest > _REST, largest, 0.0))


@jax.jit
def natural_units(problem: Problem, w: Primal) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """What a state and a control amount to, in user units: by their bounds or values; where nothing
    is said, 1, unless the dynamics tell that their size is another by far.

    They tell of one unknown from its neighbours: what moves a state of known size by as much within
    the horizon, or how far a state is moved by what is known.
    """
    problem, n, m, dtype = evened(problem), problem.n, problem.m, w.x.dtype
    seen = jnp.concatenate([w.x0[None], w.x.reshape(-1, n)])
    x = _said(*bounds_of(problem.state_bounds, n, dtype), seen)
    u = _said(*bounds_of(problem.control_bounds, m, dtype), jnp.zeros((1, m), dtype))
    known = jnp.concatenate([x, u])
    # Small numbers alone are better than nothing.
    small = jnp.concatenate([jnp.max(jnp.abs(seen), axis=0), jnp.zeros(m, dtype)])
    known = jnp.where(jnp.any(known > 0), known, small)
    rate = jax.jacfwd(with_parameters(problem, None).dynamics, argnums=(1, 2))
    ends = w.x[:, -1]
    at = jnp.concatenate(rate(w.times[0], w.x0, w.u[0, 0]), axis=1)[None]
    along = jax.vmap(rate, in_axes=(None, 0, 0))((w.times[0] + w.times[1]) / 2, ends, w.u[:, -1])
    moves = jnp.concatenate([at, jnp.concatenate(along, axis=2)])
    moves = jnp.max(jnp.where(jnp.isfinite(moves), jnp.abs(moves), 0.0), axis=0)
    moves = moves * (w.times[1] - w.times[0])

    def tell(_: Any, size: Array) -> Array:
        mover = jnp.where((size[:n, None] > 0) & (moves > 0), size[:n, None] / moves, jnp.inf)
        mover = jnp.min(mover, axis=0)
        moved = jnp.pad(jnp.max(moves * size[None], axis=1), (0, m))
        told = jnp.where(jnp.isfinite(mover), mover, moved)
        return jnp.where(size > 0, size, told)

    told = jax.lax.fori_loop(0, n + m, tell, known)
    far = (told > 0) & (jnp.abs(jnp.log10(jnp.where(told > 0, told, 1.0))) > _FAR)
    size = jnp.where(known > 0, known, jnp.where(far, told, 1.0))
    return size[:n], size[n:]


def designer_units(program: Transcription, w: Primal) -> Scale:
    """Scales from bounds and the guess; constraints and objective by their gradients there."""
    problem, size, dtype = evened(program.problem), program.sizes, program.dtype
    program = eqx.tree_at(lambda q: q.problem, program, problem)
    x, u = natural_units(problem, w)
    span = w.times[1] - w.times[0]
    t = jnp.where(span > 0, span, 1.0)
    p = jnp.where(jnp.abs(w.p) > 0, jnp.abs(w.p), 1.0)
    scale = program.scale._replace(x=x, u=u, t=t, p=p)
    program = eqx.tree_at(lambda q: q.scale, program, scale)
    scaled = jax.tree_util.tree_map(jnp.divide, w, program.units)
    # A unit away too: at rest a gradient may vanish.
    away = scaled._replace(x=scaled.x + 1.0, u=scaled.u + 1.0)
    n, weights = size.n, jnp.asarray(program.rule.w, dtype)[None, :, None]
    largest = lambda a, axis: jnp.max(
        jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0), axis=axis, initial=0.0
    )

    def slopes(w: Primal) -> tuple[Array, Array, Array]:
        """Of path constraints, endpoint cost and constraints, and running cost."""
        nodes, ends = program.derivatives(w)
        path = largest(nodes.jacobian[:, :, n + 1 :], (0, 1, 3))
        return path, largest(ends.jacobian, 1), largest(nodes.jacobian[:, :, n] / weights, None)

    here, there = slopes(scaled), slopes(away)
    path, end = (jnp.where(a > _REST * b, a, b) for a, b in zip(here[:2], there[:2], strict=True))
    usable = lambda a: jnp.where(a > 0, a, 1.0)
    objective = usable(jnp.maximum(jnp.maximum(here[2], there[2]), here[1][0]))
    end = usable(end[1:])
    end = end.at[size.end - len(program.order) :].set(1.0)  # of the knots: in units of time
    return scale._replace(path=usable(path), end=end, objective=objective)
