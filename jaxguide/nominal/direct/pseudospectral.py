"""`jg.Pseudospectral`: Problem P solved directly on a mesh, costates by covector mapping.

**Source:** Ross & Karpenko, review (2012), sections 3 and 4.
"""

import dataclasses
import operator
import time
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, on_numpy, xp
from jaxguide.host.compilation import compiled, without_collection
from jaxguide.host.lapack import single_threaded_lapack
from jaxguide.host.memory import physical_memory
from jaxguide.nominal.defects import segment_errors
from jaxguide.nominal.direct import interior_point
from jaxguide.nominal.direct.collocation import collocation
from jaxguide.nominal.direct.covectors import to_extremal
from jaxguide.nominal.direct.guess import edges, from_extremal, random_guess, straight_guess
from jaxguide.nominal.direct.implicit import sensitivity
from jaxguide.nominal.direct.limits import Limits, limits_of
from jaxguide.nominal.direct.scaling import designer_units
from jaxguide.nominal.direct.transcription import Transcription, blank_scale
from jaxguide.nominal.direct.unknowns import Arcwise
from jaxguide.nominal.direct.warm import blank_duals, duals, fits
from jaxguide.nominal.guesses import is_key
from jaxguide.nominal.method import Capabilities, Method
from jaxguide.nominal.roots import differentiable_if
from jaxguide.problem import Problem, count, endpoint_count, with_typed_leaves
from jaxguide.spectral import NodeFamily, node_family
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import Endless
from jaxguide.transforms.integrals import with_integrals
from jaxguide.transforms.relaxed import relaxed
from jaxguide.transforms.wrapped import rewrapped
from jaxguide.types import RESULTS, is_traced

RETRIES = 3  # random starts after a straight one that fails. A choice: bounds the cost of failure.
_MOST_NODES = 512  # up to which the families keep their digits: see `jaxguide/spectral/nodes.py`


def _hashable(numbers: Any) -> Any:
    """A number, or a sequence as a tuple of numbers, so that a static field can hold it."""
    numbers = np.asarray(numbers, float)
    return tuple(numbers.tolist()) if numbers.ndim else float(numbers)


class Pseudospectral(Method):
    """Direct collocation on one or many segments, solved by the interior-point method.

    **Arguments:**

    - `grid`: "lgl" (the review's choice; for one segment: on many, its two equations at each
      shared node cost accuracy), "cgl", "lgr-left", "lgr-right" (default), "lg", or a
      `jg.NodeFamily` of your own.
    - `nodes`: collocation nodes a segment. `segments`: how many, of equal length; or instead
      `fractions`, the break points of the horizon from 0 to 1. `knots`: which of the inner ones
      (counted from 1) are free: the optimiser moves them from their `fractions`, and the others
      keep their places between them. For switches, kinks and junctions.
    - `arcwise`: knowledge of each segment's arc: controls at bounds, singular, and so on.
    - `smoothing`: of controls known to be singular, a number or (m,): weights of the squares of the
      upper half of their Legendre coefficients, as in `Arcwise.smooth`; of the order of 100.
    - `relaxation`: how far the dynamics may be missed at the nodes, in state per time, a number or
      (n,): delta^N of problem B^N. Zero: not at all.
    - `time_scale`: of an infinite horizon, t = t0 + time_scale (1 + s)/(1 - s). It is solved on
      Radau nodes that leave out s = 1, where the state vanishes unless the Problem has endpoint
      constraints of its own.
    - `starts`, `seed`: how many guesses to solve from, the first straight and the others random;
      the solution of least objective is returned. Under a trace: the first that converges. Where
      the straight one fails, up to three random ones are tried anyway.
    - `tolerance`: of the scaled first-order conditions. `max_iterations`: of the optimiser.
    - `refinements`: how often `solve` may raise the number of nodes or segments (it also moves
      breaks, and frees the junctions of a clear structure) until each segment's defect between the
      nodes, relative to the state's span, is below `mesh_tolerance`. Zero: one solve. Under a
      trace and in `solve_batch` the mesh stays, and a solution whose defect is larger is
      `RESULTS.underresolved`; with zero refinements it is taken as it is.
    - `log`: print the designer units and the optimiser's iterations: objective, worst constraint,
      scaled error, barrier, regularisation, step; "r" marks restoration, "e" an estimate of the
      multipliers.
    - `quick`: compile in half the time, for programs a fifth slower. False where one mesh is solved
      on many times. Under a trace whoever compiles decides.

    **Error:** spectral in `nodes` where the solution is smooth; the Certificate measures it.
    Derivatives by parameters and by `fractions` are implicit, of the discrete solution.

    **Source:** review, eqs (10)-(16), (21), (23); Waechter & Biegler (2006).
    """

    grid: str | NodeFamily = eqx.field(static=True, default="lgr-right")
    nodes: int = eqx.field(static=True, default=6)
    segments: int = eqx.field(static=True, default=12)
    fractions: Any = None
    knots: tuple[int, ...] = eqx.field(static=True, default=())
    arcwise: Arcwise | None = None
    smoothing: Any = eqx.field(static=True, default=0.0, converter=_hashable)
    relaxation: Any = eqx.field(static=True, default=0.0, converter=_hashable)
    time_scale: float = eqx.field(static=True, default=1.0)
    starts: int = eqx.field(static=True, default=1)
    seed: int = eqx.field(static=True, default=0)
    tolerance: float = eqx.field(static=True, default=1e-9)
    max_iterations: int = eqx.field(static=True, default=500)
    refinements: int = eqx.field(static=True, default=4)
    mesh_tolerance: float = eqx.field(static=True, default=1e-7)
    log: bool = eqx.field(static=True, default=False)
    quick: bool = eqx.field(static=True, default=True)
    accuracy: ClassVar[float] = 1e-6
    capabilities: ClassVar[Capabilities] = Capabilities(
        direct=True,
        bounds=True,
        inequalities=True,
        integrals=True,
        parameters=True,
        endless=True,
        mesh=True,
        random_start=True,
    )

    def __check_init__(self):
        node_family(self.grid, "Pseudospectral: grid")
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
        for name in ("relaxation", "smoothing"):
            if not np.all(np.asarray(getattr(self, name)) >= 0):
                raise ValueError(
                    f"Pseudospectral: {name} is {getattr(self, name)}; need at least 0."
                )
        if not self.time_scale > 0:
            raise ValueError(f"Pseudospectral: time_scale is {self.time_scale}; give one above 0.")
        collocation(self.grid, self.nodes)

    def check(self, problem: Problem) -> None:
        """Refuses a mesh that memory will not hold, or that integrals do not go with. Host only.

        **Raises:** `ValueError`, with the estimate.
        """
        if len(collocation(self.grid, self.nodes).extra) and count(problem, "integrands"):
            raise ValueError(
                f"Pseudospectral: grid {self.grid!r} collocates at both ends, one equation a "
                f"segment more than an integral has unknowns, and {type(problem).__name__} has "
                "integral constraints; use 'lgr-right', 'lgr-left' or 'lg'."
            )
        need, have = self.memory(problem), physical_memory()
        if need > have:
            segments = self.segments if self.fractions is None else len(self.fractions) - 1
            raise ValueError(
                f"Pseudospectral: {segments} segments of {self.nodes} nodes with {problem.n} "
                f"states and {problem.m} controls need some {need / 1e9:.3g} GB of the "
                f"{have / 1e9:.3g} GB here; use fewer nodes and more segments."
            )

    def memory(self, problem: Problem) -> float:
        """Bytes of a Newton step, roughly: a segment's factors, the directions that its nodes'
        inputs take, and a few copies."""
        segments = self.segments if self.fractions is None else len(self.fractions) - 1
        n, m, C = problem.n, problem.m, float(self.nodes)
        basis = (C + 1) * n + C * m
        directions = 2 * n + C * m + 2
        entries = 2 * basis**2 + 4 * basis * directions + directions**2
        return 8 * segments * (3 * entries + C * (n + m + 2) ** 2 * 4)

    def __call__(self, problem: Problem, guess: Any) -> Extremal:
        """The extremal on the fixed mesh. Where `solve` would refine it on the host, one short of
        `mesh_tolerance` is `RESULTS.underresolved`."""
        program, start, options = self.prepared(problem, guess)
        starts = self._starts(program, start, guess)
        extremal = finished(problem, program, starts, options)
        if not self.refinements:
            return extremal
        resolved = jnp.max(segment_errors(extremal)) <= self.mesh_tolerance
        good = extremal.result == RESULTS.successful
        result = RESULTS.where(good & ~resolved, RESULTS.underresolved, extremal.result)
        return dataclasses.replace(extremal, result=result)

    def run(self, problem: Problem, guess: Any) -> Extremal:
        """On the host with NumPy, which compiles the Problem's functions alone; once a program of
        this size has taken there as long as compiling it would, compiled. What the host may refine
        is not judged here."""
        if self.log:
            units = self.units(problem, guess).items()
            print("designer units: " + ", ".join(f"{k} {v:.4g}" for k, v in units))
        with without_collection(), np.errstate(all="ignore"):
            near = guess if is_key(guess) else jax.device_get(guess)
            method, stated = jax.device_get((self, problem))
            program, start, options = method.prepared(stated, near)
            limits = limits_of(program)
            solution = _minimised(program, limits, start, options, self.quick)
            return to_extremal(stated, program, limits, solution)

    def units(self, problem: Problem, guess: Any = None) -> dict[str, float]:
        """Designer units: what the solver takes for one of each state, control, time, constraint
        and objective, in user units, from bounds and guess. Also printed by `log`. Host only."""
        with np.errstate(all="ignore"):
            stated = jax.device_get(with_typed_leaves(problem))
            near = guess if is_key(guess) else jax.device_get(guess)
            scale = jax.device_get(self).prepared(stated, near)[0].scale
        numbered = lambda what, k: [f"{what} {i}" for i in range(k)]
        paths = [".".join(map(str, path)) for path in problem.parameter_paths()]
        q = endpoint_count(problem)
        named = (
            (problem.state_names, scale.x),
            (problem.control_names, scale.u),
            (("time",), scale.t[None]),
            (paths, scale.p),
            (numbered("path constraint", scale.path.shape[0]), scale.path),
            (numbered("endpoint constraint", q), scale.end),
            (("objective",), scale.objective[None]),
        )
        return {k: float(v) for names, values in named for k, v in zip(names, values, strict=False)}

    def whole(self, problem: Problem) -> Problem:
        """`problem` with what the transcription needs besides: integrals, relaxed dynamics."""
        whole = with_integrals(problem)
        if not np.any(np.asarray(self.relaxation)):
            return whole
        delta = xp.broadcast_to(xp.asarray(self.relaxation, jnp.result_type(float)), (problem.n,))
        return relaxed(whole, xp.pad(delta, (0, whole.n - problem.n)))

    def _arcwise(self, problem: Problem, whole: Problem, segments: int) -> Arcwise | None:
        """`arcwise`, `smoothing` added, with entries for what `whole` has besides."""
        known = self.arcwise
        if np.any(np.asarray(self.smoothing)):
            known = Arcwise.blank(segments, problem) if known is None else known
            weights = xp.asarray(self.smoothing, jnp.result_type(float))
            weights = known.smooth + xp.broadcast_to(weights, (problem.m,))[None]
            known = dataclasses.replace(known, smooth=weights)
        if known is None:
            return None
        more = lambda a, k: xp.pad(a, (*((0, 0),) * (a.ndim - 1), (0, k - a.shape[-1])))
        return Arcwise(
            more(known.held, whole.m),
            more(known.smooth, whole.m),
            more(known.released, whole.n),
            known.unpathed,
            more(known.loose, whole.m),
        )

    def _fractions(self, dtype: Any) -> Float[Array, " edge"]:
        """The break points of the horizon, from 0 to 1."""
        if self.fractions is None:
            return xp.linspace(0.0, 1.0, self.segments + 1, dtype=dtype)
        return xp.asarray(self.fractions, dtype)

    def _starts(
        self, program: Transcription, start: interior_point.Start, guess: Any
    ) -> interior_point.Start:
        """`start`, and without a guess `RETRIES` random ones, along a leading axis."""
        first = jax.tree_util.tree_map(lambda a: jnp.asarray(a)[None], start)
        if guess is not None:
            return first
        fractions = self._fractions(program.dtype)

        def drawn(key: Array) -> interior_point.Start:
            # Copies, whose cached arrays belong to this trace.
            unit = blank_scale(program.problem, len(self.knots))
            stated = dataclasses.replace(program, scale=unit)
            w = random_guess(stated, fractions, self.knots, key)
            return _begun(dataclasses.replace(program), w)

        keys = jax.vmap(self.key)(jnp.arange(1, RETRIES + 1))
        others = jax.lax.stop_gradient(jax.lax.map(drawn, keys))
        return jax.tree_util.tree_map(lambda *a: jnp.concatenate(a), first, others)

    def key(self, k: Any) -> Array:
        """The random key of the `k`th start after the straight one."""
        return jax.random.fold_in(jax.random.key(self.seed), k)

    def prepared(
        self, problem: Problem, guess: Any
    ) -> tuple[Transcription, interior_point.Start, interior_point.Options]:
        """The transcription in designer units, where the search starts, and how."""
        single_threaded_lapack()
        dtype = jnp.result_type(float)
        # Where the search starts does not matter to the solution; where the breaks are, does.
        still = lambda a: a if on_numpy(a) else jax.lax.stop_gradient(a)
        problem = jax.tree_util.tree_map(still, problem)
        on_host = on_numpy(*jax.tree_util.tree_leaves(problem))
        # One array of JAX's would bring the whole algebra to it, operation by operation.
        whole = jax.device_get(self.whole(problem)) if on_host else self.whole(problem)
        fractions = self._fractions(dtype)
        unit = blank_scale(whole, len(self.knots))
        # At the end of an infinite horizon time stands still: no node may lie there.
        family = "lgr-left" if isinstance(problem, Endless) else self.grid
        program = Transcription(
            whole, unit, edges(fractions, self.knots), family, self.nodes,
            self._arcwise(problem, whole, fractions.shape[0] - 1), self.log,
        )  # fmt: skip
        if guess is None:
            w = straight_guess(program, fractions, self.knots)
        elif is_key(guess):
            w = random_guess(program, fractions, self.knots, guess)
        else:
            w = from_extremal(program, fractions, self.knots, problem, guess)
        scale = designer_units(program, w)
        program = dataclasses.replace(program, scale=scale)
        start = _begun(program, w)
        w = start.w
        # A guess that is an extremal needs less distance from the bounds, and a lower barrier.
        mu, push, warm = 0.1, 1e-2, False
        if isinstance(guess, Extremal):
            mu, push = 1e-3, 1e-3
            if fits(program, guess):
                start, warm = start._replace(**duals(program, fractions, w, guess)), True
                mu, push = 1e-6, 1e-6
        options = interior_point.Options(self.tolerance, mu, self.max_iterations, push, warm)
        unmoved, start = jax.tree_util.tree_map(still, (program, start))
        program = dataclasses.replace(unmoved, edges=program.edges)
        number = np.asarray if on_numpy(w.x0) else jnp.asarray
        options = jax.tree_util.tree_map(number, options)
        most = number(self.max_iterations, np.int32)
        return program, start, options._replace(max_iterations=most)


def finished(
    problem: Problem,
    program: Transcription,
    starts: interior_point.Start,
    options: interior_point.Options,
) -> Extremal:
    """The extremal that the optimiser finds from the first of `starts` (with a leading axis) from
    which it converges. One compiled program serves every guess, break and scale."""
    whole = rewrapped(program.problem, problem)
    solution = _solved((whole, program.edges), program, starts, options)
    program = _stated(program, (whole, program.edges))
    extremal = to_extremal(problem, program, limits_of(program), solution)
    return differentiable_if(extremal.result == RESULTS.successful, extremal, problem)


# Seconds that programs of each size have taken on the host, and those after which one is compiled:
# about what compiling takes, so that whoever solves once or a thousand times waits at most twice as
# long as was needed. Measured: 4.2 s with 3 states and controls, 6.0 with 16, 13 with 40.
_on_host_so_far: dict[Any, float] = {}
_WORTH_COMPILING, _MORE = 4.0, 0.2  # and so much for each state and control


def _minimised(
    program: Transcription,
    limits: Limits,
    start: interior_point.Start,
    options: interior_point.Options,
    quick: bool,
) -> interior_point.Solution:
    """`interior_point.minimise` by NumPy, and compiled from the iteration on at which that is worth
    it: the first if `quick` is False, or if an earlier process kept the program."""
    began, further = time.perf_counter(), compiled(interior_point.iterated, quick)
    leaves, structure = jax.tree_util.tree_flatten((program, start))
    size = (structure, *map(np.shape, leaves))
    state = interior_point.begun(program, limits, start, options)
    on_device = lambda state: jax.device_put((program, limits, options, state))
    if size not in _on_host_so_far:
        known = further.is_kept(*on_device(state))
        _on_host_so_far[size] = np.inf if known else 0.0
    spent, more = _on_host_so_far[size], _MORE * (program.counts.n + program.counts.m)
    least = _WORTH_COMPILING + more if quick else 0.0
    here = lambda: spent + time.perf_counter() - began < least
    state = interior_point.iterated(program, limits, options, state, here)
    _on_host_so_far[size] = spent + time.perf_counter() - began
    if state.status == interior_point.RUNNING:
        state = jax.device_get(further(*on_device(state)))
    return interior_point.ended(program, state)


@jax.custom_batching.sequential_vmap
def _one_at_a_time(
    program: Transcription,
    limits: Limits,
    starts: interior_point.Start,
    options: interior_point.Options,
) -> interior_point.Solution:
    """From one of `starts` after another until one converges; otherwise the end that violates the
    constraints least. Under `vmap` one problem after another: batched LAPACK may hang on CPU and
    gains nothing."""
    count = starts.w.x0.shape[0]
    pick = lambda k: jax.tree_util.tree_map(lambda a: a[k], starts)
    # A copy, whose cached arrays belong to the trace of each call.
    own = lambda: dataclasses.replace(program)
    once = lambda k: interior_point.minimise(own(), limits, pick(k), options)
    if count == 1:
        return once(0)

    def another(carry: tuple[Array, interior_point.Solution]) -> tuple[Array, Any]:
        k, best = carry
        new = once(k)
        good = (new.status == interior_point.CONVERGED) | ~(new.violation >= best.violation)
        choose = lambda a, b: jnp.where(good, a, b)
        return k + 1, jax.tree_util.tree_map(choose, new, best)

    blank = jax.eval_shape(once, 0)
    blank = jax.tree_util.tree_map(lambda a: jnp.zeros(a.shape, a.dtype), blank)
    blank = blank._replace(violation=jnp.full_like(blank.violation, jnp.inf))
    going = lambda c: (c[0] < count) & (c[1].status != interior_point.CONVERGED)
    return jax.lax.while_loop(going, another, (jnp.zeros((), jnp.int32), blank))[1]


def _begun(program: Transcription, w: Any) -> interior_point.Start:
    """A start from the guess `w` in user units, its slacks the constraints' values."""
    w = jax.tree_util.tree_map(operator.truediv, w, program.units)
    node, end = program.values(w)
    w = w._replace(path=node[:, :, program.problem.n + 1 :], end=end[1:])
    return interior_point.Start(w, *blank_duals(program, w))


def _stated(program: Transcription, given: tuple[Problem, Array]) -> Transcription:
    """`program` for another problem, on other breaks."""
    return eqx.tree_at(lambda p: (p.problem, p.edges), program, given)


@eqx.filter_custom_jvp
def _solved(
    given: tuple[Problem, Array],
    program: Transcription,
    starts: interior_point.Start,
    options: interior_point.Options,
) -> interior_point.Solution:
    """The solution for `given`, a problem and the breaks of the mesh, in the units of `program`."""
    program = _stated(program, given)
    return _one_at_a_time(program, limits_of(program), starts, options)


@_solved.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    """The implicit function theorem on the conditions that the optimiser met, never its steps."""
    given, program, starts, options = primals
    solution = _solved(given, program, starts, options)
    return solution, sensitivity(_stated(program, given), solution, tangents[0])
