"""`jg.Pseudospectral`: Problem P solved directly on a mesh, costates by covector mapping.

**Source:** Ross & Karpenko, review (2012), sections 3 and 4.
"""

import math
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.linalg import single_threaded_lapack
from jaxguide.linalg import solve as small_solve
from jaxguide.nominal import interior_point, kkt
from jaxguide.nominal.implicit import sensitivity
from jaxguide.nominal.mesh import FAMILIES, collocation, left_null
from jaxguide.nominal.shooting import unwrap_angles
from jaxguide.nominal.transcription import (
    Arcwise,
    Bounds,
    Primal,
    Rows,
    Scale,
    Transcription,
    bounds,
    constraint_counts,
    node_times,
)
from jaxguide.nominal.wrappers import Endless, relaxed, rewrapped, with_integrals
from jaxguide.problem import (
    Problem,
    bounds_of,
    initial_values,
    initially_free,
    is_free,
    parameters,
    start_control,
    start_value,
    with_parameters,
)
from jaxguide.spectral import interpolation_matrix
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.types import RESULTS, is_traced

_MOST_NODES = 512


class Pseudospectral(eqx.Module):
    """Direct collocation on one or many segments, solved by the interior-point method.

    **Arguments:**

    - `grid`: "lgl" (the review's choice; for one segment: on many, its two equations at each
      shared node cost accuracy), "cgl", "lgr-left", "lgr-right" (default) or "lg".
    - `nodes`: collocation nodes a segment. `segments`: how many, of equal length; or instead
      `fractions`, the break points of the horizon from 0 to 1. `knots`: which of the inner ones
      (counted from 1) are free: the optimiser places them, from where `fractions` says, and the
      others keep their places between them. For switches, kinks and junctions.
    - `arcwise`: what is known of each segment's arc: controls at bounds, singular, and so on.
    - `relaxation`: how far the dynamics may be missed at the nodes, in state per time, a number or
      (n,): delta^N of problem B^N. Zero: not at all.
    - `time_scale`: of an infinite horizon, t = t0 + time_scale (1 + s)/(1 - s). It is solved on
      Radau nodes that leave out s = 1, where the state vanishes unless the Problem has endpoint
      constraints of its own.
    - `starts`, `seed`: how many guesses to solve from, the first straight and the others random,
      for the best of what they find. Under a trace: one.
    - `tolerance`: of the scaled first-order conditions. `max_iterations`: of the optimiser.
    - `refinements`: how often `solve` may raise the number of nodes or segments (it also moves
      breaks, and frees the junctions of a clear structure) until each segment's defect between the
      nodes, relative to the state's span, is below `mesh_tolerance`. Zero: one solve. Under a
      trace the mesh stays.
    - `log`: print the optimiser's iterations: objective, worst constraint, scaled error, barrier,
      regularisation, step; "r" marks restoration, "e" an estimate of the multipliers.

    **Error:** spectral in `nodes` where the solution is smooth; the Certificate tells.

    **Source:** review, eqs (10)-(16), (21), (23); Waechter & Biegler (2006).
    """

    grid: str = eqx.field(static=True, default="lgr-right")
    nodes: int = eqx.field(static=True, default=6)
    segments: int = eqx.field(static=True, default=12)
    fractions: Any = None
    knots: tuple[int, ...] = eqx.field(static=True, default=())
    arcwise: Arcwise | None = None
    relaxation: Any = eqx.field(static=True, default=0.0)
    time_scale: float = eqx.field(static=True, default=1.0)
    starts: int = eqx.field(static=True, default=1)
    seed: int = eqx.field(static=True, default=0)
    tolerance: float = eqx.field(static=True, default=1e-9)
    max_iterations: int = eqx.field(static=True, default=500)
    refinements: int = eqx.field(static=True, default=4)
    mesh_tolerance: float = eqx.field(static=True, default=1e-7)
    log: bool = eqx.field(static=True, default=False)
    accuracy = 1e-6  # that its certificates ask for

    def __check_init__(self):
        if self.grid not in FAMILIES:
            raise ValueError(
                f"Pseudospectral: grid is {self.grid!r}; choose one of {', '.join(FAMILIES)}."
            )
        if self.segments < 1:
            raise ValueError(f"Pseudospectral: segments is {self.segments}; give at least 1.")
        if self.max_iterations < 1:
            raise ValueError(f"Pseudospectral: max_iterations is {self.max_iterations}.")
        if self.starts < 1:
            raise ValueError(f"Pseudospectral: starts is {self.starts}; give at least 1.")
        if self.nodes > _MOST_NODES:
            raise ValueError(
                f"Pseudospectral: nodes is {self.nodes}; give at most {_MOST_NODES}, with which "
                "interpolation still keeps its digits, and more segments."
            )
        if self.refinements < 0:
            raise ValueError(f"Pseudospectral: refinements is {self.refinements}; need at least 0.")
        for name in ("tolerance", "mesh_tolerance"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(
                    f"Pseudospectral: {name} is {getattr(self, name)}; give one in (0, 1)."
                )
        if self.fractions is not None and not is_traced(self.fractions):
            given = np.asarray(self.fractions, float)
            ends = given.ndim == 1 and given.size > 1 and (given[0], given[-1]) == (0.0, 1.0)
            if not ends or not np.all(np.diff(given) > 0):
                raise ValueError(
                    f"Pseudospectral: fractions is {self.fractions}; give break points that "
                    "ascend from 0 to 1, such as (0, 0.3, 1)."
                )
        breaks = self.segments if self.fractions is None else np.shape(self.fractions)[0] - 1
        if any(not 0 < k < breaks for k in self.knots) or len(set(self.knots)) < len(self.knots):
            raise ValueError(
                f"Pseudospectral: knots is {self.knots}; name each inner break once, from 1 to "
                f"{breaks - 1}."
            )
        if not np.all(np.asarray(self.relaxation) >= 0):
            raise ValueError(f"Pseudospectral: relaxation is {self.relaxation}; need at least 0.")
        if not self.time_scale > 0:
            raise ValueError(f"Pseudospectral: time_scale is {self.time_scale}; give one above 0.")
        collocation(self.grid, self.nodes)

    def check_fields(self, problem: Problem) -> None:
        """Nothing that a Problem may hold is beyond it. Host only."""

    def check(self, problem: Problem) -> None:
        """Refuses a mesh that memory will not hold. Host only.

        **Raises:** `ValueError` with the estimate.
        """
        need, have = self.memory(problem), _physical_memory()
        if need > have:
            segments = self.segments if self.fractions is None else len(self.fractions) - 1
            raise ValueError(
                f"Pseudospectral: {segments} segments of {self.nodes} nodes with {problem.n} "
                f"states and {problem.m} controls need some {need / 1e9:.3g} GB of the "
                f"{have / 1e9:.3g} GB here; use fewer nodes and more segments."
            )

    def memory(self, problem: Problem) -> float:
        """Bytes of a Newton step, roughly: a segment's orthonormal basis, the directions that its
        nodes' inputs take, and a few copies."""
        segments = self.segments if self.fractions is None else len(self.fractions) - 1
        n, m, C = problem.n, problem.m, float(self.nodes)
        basis = (C + 1) * n + C * m
        directions = 2 * n + C * m + 2
        entries = 2 * basis**2 + 4 * basis * directions + directions**2
        return 8 * segments * (3 * entries + C * (n + m + 2) ** 2 * 4)

    def __call__(self, problem: Problem, guess: Any, certifier: Any) -> Extremal:
        """The extremal on the fixed mesh, without host checks; `solve` wraps this."""
        return finished(problem, *self.prepared(problem, guess), certifier)

    def whole(self, problem: Problem) -> Problem:
        """`problem` with what the transcription needs besides: integrals, relaxed dynamics."""
        whole = with_integrals(problem)
        if not np.any(np.asarray(self.relaxation)):
            return whole
        delta = jnp.broadcast_to(jnp.asarray(self.relaxation, jnp.result_type(float)), (problem.n,))
        return relaxed(whole, jnp.pad(delta, (0, whole.n - problem.n)))

    def _arcwise(self, whole: Problem) -> Arcwise | None:
        """`arcwise` with entries for the states and controls that `whole` has besides."""
        known = self.arcwise
        if known is None:
            return None
        more = lambda a, k: jnp.pad(a, (*((0, 0),) * (a.ndim - 1), (0, k - a.shape[-1])))
        return Arcwise(
            more(known.held, whole.m),
            more(known.smooth, whole.m),
            more(known.released, whole.n),
            known.unpathed,
        )

    def prepared(
        self, problem: Problem, guess: Any
    ) -> tuple[Transcription, interior_point.Start, interior_point.Options]:
        """The transcription in designer units, where the search starts, and how."""
        single_threaded_lapack()
        dtype = jnp.result_type(float)
        whole = self.whole(problem)
        if self.fractions is None:
            fractions = jnp.linspace(0.0, 1.0, self.segments + 1, dtype=dtype)
        else:
            fractions = jnp.asarray(self.fractions, dtype)
        unit = unit_scale(whole, len(self.knots))
        # At the end of an infinite horizon time stands still: no node may lie there.
        family = "lgr-left" if isinstance(problem, Endless) else self.grid
        program = Transcription(
            whole, unit, edges(fractions, self.knots), family, self.nodes, self._arcwise(whole),
            self.log,
        )  # fmt: skip
        if guess is None:
            w = straight_guess(program, fractions, self.knots)
        elif is_key(guess):
            w = random_guess(program, fractions, self.knots, guess)
        elif isinstance(guess, Extremal):
            w = from_extremal(program, fractions, self.knots, problem, guess)
        else:
            raise ValueError(
                f"guess is a {type(guess).__name__}; jg.Pseudospectral takes an Extremal (costates "
                "are for jg.Shooting), a random key, or None."
            )
        scale = designer_units(program, w)
        program = eqx.tree_at(lambda p: p.scale, program, scale)
        w = jax.tree_util.tree_map(jnp.divide, w, program.units)
        node, end = program.values(w)
        w = w._replace(path=node[:, :, whole.n + 1 :], end=end[1:])
        start = interior_point.Start(w, *blank_duals(program, w))
        # A guess that is an extremal needs less distance from the bounds, and a lower barrier.
        mu, push, warm = 0.1, 1e-2, False
        if isinstance(guess, Extremal):
            mu, push = 1e-3, 1e-3
            if fits(program, guess):
                start, warm = start._replace(**duals(program, fractions, w, guess)), True
                mu, push = 1e-6, 1e-6
        options = interior_point.Options(self.tolerance, mu, self.max_iterations, push, warm)
        out = jax.lax.stop_gradient((program, start))
        return *out, jax.tree_util.tree_map(jnp.asarray, options)


def finished(
    problem: Problem,
    program: Transcription,
    start: interior_point.Start,
    options: interior_point.Options,
    certifier: Any,
) -> Extremal:
    """What the optimiser makes of `Pseudospectral.prepared`: one program for every guess, break
    and scale."""
    whole = rewrapped(program.problem, problem)
    solution = _solved(whole, program, start, options)
    program = eqx.tree_at(lambda p: p.problem, program, whole)
    return to_extremal(problem, program, bounds(program), solution, certifier)


def _physical_memory() -> float:
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):  # where the system does not say
        return math.inf


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


@jax.custom_batching.sequential_vmap
def _one_at_a_time(
    program: Transcription,
    box: Bounds,
    start: interior_point.Start,
    options: interior_point.Options,
) -> interior_point.Solution:
    """Under `vmap` one problem after another: batched LAPACK may hang on CPU and gains nothing."""
    return interior_point.minimise(program, box, start, options)


@eqx.filter_custom_jvp
def _solved(
    problem: Problem,
    program: Transcription,
    start: interior_point.Start,
    options: interior_point.Options,
) -> interior_point.Solution:
    """The solution for `problem` in the units and on the mesh of `program`."""
    program = eqx.tree_at(lambda p: p.problem, program, problem)
    return _one_at_a_time(program, bounds(program), start, options)


@_solved.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    """The implicit function theorem on the conditions that the optimiser met, never its steps."""
    problem, program, start, options = primals
    solution = _solved(problem, program, start, options)
    program = eqx.tree_at(lambda p: p.problem, program, problem)
    return solution, sensitivity(program, solution, tangents[0])


def unit_scale(problem: Problem, knots: int) -> Scale:
    path, end = constraint_counts(problem)
    end += knots + 1 if knots else 0
    one = jnp.ones((), jnp.result_type(float))
    many = lambda k: jnp.ones(k, one.dtype)
    return Scale(
        many(problem.n), many(problem.m), one, many(len(parameters(problem))), many(path),
        many(end), one,
    )  # fmt: skip


def horizon_guess(problem: Problem) -> tuple[Array, Array]:
    """Times to start from: given, guessed, or one unit where nothing is said."""
    dtype = jnp.result_type(float)
    t0 = jnp.asarray(start_value(problem.initial_time), dtype)
    tf = problem.final_time
    if not is_free(tf) or tf.guess is not None:
        return t0, jnp.asarray(start_value(tf), dtype)
    lo, hi = jnp.asarray(tf.lo, dtype), jnp.asarray(tf.hi, dtype)
    bounded = jnp.isfinite(lo) & jnp.isfinite(hi)
    return t0, jnp.where(bounded, start_value(tf), jnp.clip(t0 + 1.0, lo, hi))


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
    scale = jnp.tile(typical(lo, hi, x0[None]), 2)
    # Free components of the initial state move with the final ones.
    free = jnp.concatenate([jnp.asarray(initially_free(program.problem)), jnp.ones(n, bool)])
    scale = jnp.where(free, scale, 0.0)
    low, high = jnp.tile(lo, 2), jnp.tile(hi, 2)

    def nearer(_: Any, ends: Array) -> Array:
        def at(y: Array) -> Array:
            moved = ends + y * scale
            return problem.endpoint_constraints(moved[:n], moved[n:], t0, tf)

        e, J = at(jnp.zeros_like(ends)), jax.jacfwd(at)(jnp.zeros_like(ends))
        miss = e - jnp.clip(e, e_lo, e_hi)
        gram = J @ J.T
        ridge = 1e-8 * (jnp.trace(gram) + 1e-30) * jnp.eye(q, dtype=dtype)
        step = J.T @ small_solve(gram + ridge, miss)
        step = jnp.where(jnp.isfinite(step), step, 0.0)
        return jnp.where(free, jnp.clip(ends - scale * step, low, high), ends)

    ends = jnp.tile(x0, 2)
    ends = jax.lax.fori_loop(0, 8, nearer, ends) if q else ends
    x0, xf = ends[:n], ends[n:]
    u = start_control(program.problem, dtype)
    s = fractions_at(fractions, program.rule.support[1:])
    x = x0[None, None] + s[:, :, None] * (xf - x0)[None, None]
    u = jnp.broadcast_to(u, (size.segments, size.nodes, size.m))
    p = [start_value(v) for v in parameters(program.problem)]
    times = placed(t0, tf, fractions, knots)
    return without_slacks(program, x0, x, u, times, p)


def is_key(guess: Any) -> bool:
    """Whether `guess` is a random key: a random start."""
    return isinstance(guess, jax.Array) and jnp.issubdtype(guess.dtype, jax.dtypes.prng_key)


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
    scale = typical(lo, hi, jnp.concatenate([w.x0[None], w.x.reshape(-1, size.n)]))
    waves = jax.random.normal(k_x, (2, size.n), dtype) * scale[None] / 3
    s = fractions_at(fractions, rule.support[1:])
    bent = sum(jnp.sin((k + 1) * jnp.pi * s)[..., None] * waves[k][None, None] for k in range(2))
    x = jnp.clip(w.x + bent, lo[None, None], hi[None, None])
    u_lo, u_hi = bounds_of(program.problem.control_bounds, size.m, dtype)
    bounded = jnp.isfinite(u_lo) & jnp.isfinite(u_hi)
    middle = jnp.where(bounded, (u_lo + u_hi) / 2, 0.0)
    half = jnp.where(bounded, (u_hi - u_lo) / 2, 3.0)
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


def typical(lo: Array, hi: Array, seen: Float[Array, "k n"]) -> Float[Array, " n"]:
    """The larger finite bound; else the largest value seen; else 1."""
    bounded = jnp.isfinite(lo) & jnp.isfinite(hi)
    wide = jnp.where(bounded, jnp.maximum(jnp.abs(lo), jnp.abs(hi)), 0.0)
    scale = jnp.where(bounded & (wide > 0), wide, jnp.max(jnp.abs(seen), axis=0))
    return jnp.where(scale > 1e-8, scale, 1.0)


def designer_units(program: Transcription, w: Primal) -> Scale:
    """Scales from bounds and the guess; constraints and objective by their gradients there."""
    problem, size, dtype = program.problem, program.sizes, program.dtype
    x_lo, x_hi = bounds_of(problem.state_bounds, size.n, dtype)
    u_lo, u_hi = bounds_of(problem.control_bounds, size.m, dtype)
    x = typical(x_lo, x_hi, jnp.concatenate([w.x0[None], w.x.reshape(-1, size.n)]))
    u = typical(u_lo, u_hi, jnp.zeros((1, size.m), dtype))
    t = jnp.maximum(w.times[1] - w.times[0], 1e-8)
    p = jnp.where(jnp.abs(w.p) > 0, jnp.abs(w.p), 1.0)
    scale = program.scale._replace(x=x, u=u, t=t, p=p)
    program = eqx.tree_at(lambda q: q.scale, program, scale)
    scaled = jax.tree_util.tree_map(jnp.divide, w, program.units)
    nodes, ends = program.derivatives(scaled)
    n = size.n
    rows = jnp.max(jnp.abs(nodes.jacobian), axis=(0, 1, 3), initial=0.0)
    usable = lambda a: jnp.where(jnp.isfinite(a) & (a > 1e-8), a, 1.0)
    # The objective's gradient a unit away too: at rest it may vanish.
    away = scaled._replace(x=scaled.x + 1.0, u=scaled.u + 1.0)
    steeper, _ = program.derivatives(away)
    weights = jnp.asarray(program.rule.w, dtype)[None, :, None]
    largest = lambda a: jnp.max(jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0))
    cost = jnp.maximum(
        largest(nodes.jacobian[:, :, n] / weights), largest(steeper.jacobian[:, :, n] / weights)
    )
    end_rows = jnp.max(jnp.abs(ends.jacobian), axis=1)
    objective = usable(jnp.maximum(cost, end_rows[0]))
    end = usable(end_rows[1:])
    end = end.at[size.end - len(program.order) :].set(1.0)  # of the knots: in units of time
    return scale._replace(path=usable(rows[n + 1 :]), end=end, objective=objective)


def to_extremal(
    problem: Problem,
    program: Transcription,
    box: Bounds,
    solution: interior_point.Solution,
    certifier: Any,
) -> Extremal:
    """User units; costates by the covector mapping theorem (eqs 23-25)."""
    size, rule, scale, w = program.sizes, program.rule, program.scale, solution.w
    dtype, n = program.dtype, size.n
    problem = with_parameters(problem, w.p * scale.p)
    support = program.support(w)
    whole = lambda a: jnp.concatenate([jnp.concatenate(a[:, :-1]), a[-1, -1:]])
    t_support = node_times(program, w, rule.support)
    t = jnp.concatenate([t_support[:, :-1].reshape(-1), t_support[-1, -1:]])
    lam, before, impulse = costates(program, box, solution)
    nodes, ends = program.derivatives(w)
    left = kkt.gradient(program, nodes, ends, w, solution.y).u
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
    k, m, r = problem.n, problem.m, n - problem.n
    q = size.end - len(program.order) - r
    nu = solution.y.end * scale.objective / scale.end
    f, _ = program.objective_and_residual(w)
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
        residual=solution.violation,
        problem=problem,
        certifier=certifier,
    )


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
