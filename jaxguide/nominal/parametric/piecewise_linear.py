"""`jg.PiecewiseLinear`: the control as a parameter vector, optimised (thesis, chapter 2)."""

import functools
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of, positive
from jaxguide.conditions.bounded import oversteps
from jaxguide.conditions.units import natural_units
from jaxguide.nominal.ends import nearest_ends
from jaxguide.nominal.method import Capabilities, Method
from jaxguide.nominal.parametric import flow as par
from jaxguide.nominal.parametric.equality import KKTPoint, local_minimum, polished, residual
from jaxguide.nominal.parametric.extremal import parametric_extremal
from jaxguide.nominal.roots import differentiable_if
from jaxguide.nominal.starts import control_ends
from jaxguide.problem import (
    Problem,
    count,
    endpoint_count,
    initially_free,
    is_free,
    start_control,
    start_value,
)
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS, is_traced

# Newton's steps from one start: chosen, not tuned, far more than a good start takes.
_ITERATIONS = 100
# Scaled KKT residual up to which a solution counts as converged, some 1e4 roundings, and a start as
# worth polishing, from where Newton's method doubles the digits with each step.
_TOLERANCE, _FOUND = 1e-12, 1e-6
# By how much of its size a bound may be overstepped: the method's `accuracy`.
_WITHIN = 1e-9
# Random starts: half the range of a control without bounds, in its units; a horizon within twice
# the guess (log 2 = 0.7). Chosen, not tuned.
_HALF, _SPREAD = 1.0, 0.7


class PiecewiseLinear(Method):
    """Suboptimal control: node values of a piecewise-linear control, and a free final time, that
    minimise the cost subject to the endpoint constraints.

    The flow is by Dormand-Prince steps of order eight, `degree` to an interval; the parameters by
    Newton on the KKT system with exact second derivatives, from a constant control and from random
    straight ones. Derivatives, in node positions too, are implicit.

    **Arguments:**

    - `nodes`: how many, evenly spaced, or their positions on [0, 1], ends included.
    - `degree`: of the returned Extremal between nodes, and steps of the flow there.
    - `starts`, `seed`: how many starts without a guess; all but the first random.

    **Error:** KKT residual to 1e-12, scaled; the cost exceeds the optimum by the spacing's fourth
    power. H_u = 0 holds on average about each node (a row of the certificate) and not at every
    time: that row fails, by as much as the control is off, and with it those of H pointwise.

    **Raises:** `ValueError` for nodes that are too few, out of order, repeated, or not from 0 to 1.

    **Source:** Libby's thesis, eqs (2.5)-(2.13); Hull & Helfrich (1992).
    """

    positions: Float[Array, " k"]
    degree: int = eqx.field(static=True)
    starts: int = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    accuracy: ClassVar[float] = 1e-9
    capabilities: ClassVar[Capabilities] = Capabilities(
        direct=False, array_guess="the controls at the nodes"
    )
    quick = True

    def __init__(self, nodes: Any = 9, degree: int = 8, starts: int = 8, seed: int = 0):
        if isinstance(nodes, (int, np.integer)):
            if nodes < 2:
                raise ValueError(f"PiecewiseLinear: nodes={nodes}; need at least 2, the ends.")
            nodes = np.linspace(0.0, 1.0, int(nodes))
        self.positions = jnp.asarray(nodes, jnp.result_type(float))
        self.degree, self.starts, self.seed = degree, starts, seed
        if self.positions.ndim != 1 or self.positions.shape[0] < 2:
            raise ValueError(
                f"PiecewiseLinear: nodes of shape {self.positions.shape}; give their number, or at "
                "least two positions on [0, 1]."
            )
        if not is_traced(nodes):
            _check_positions(np.asarray(nodes, float))
        for name, least in (("degree", 2), ("starts", 1)):
            if getattr(self, name) < least:
                raise ValueError(
                    f"PiecewiseLinear: {name}={getattr(self, name)}; need at least {least}."
                )

    def check(self, problem: Problem) -> None:
        """Refuses free initial data, path constraints, and fewer parameters than constraints.

        **Raises:** `ValueError`.
        """
        kind = type(problem).__name__
        free = initially_free(problem)
        if any(free):
            raise ValueError(
                f"{kind}.initial_state: {problem.state_names[free.index(True)]} is free, but "
                "PiecewiseLinear starts from a given state; give it a number, or use "
                "jg.Pseudospectral."
            )
        if is_free(problem.initial_time):
            raise ValueError(
                f"{kind}.initial_time is a jg.Free, which PiecewiseLinear does not choose; give it "
                "a number, or use jg.Pseudospectral."
            )
        if paths := count(problem, "path_constraints"):
            raise ValueError(
                f"{kind}.path_constraints: {paths} of them, which PiecewiseLinear does not "
                "enforce; leave them out, or use jg.Pseudospectral."
            )
        q = endpoint_count(problem)
        size = self.positions.shape[0] * problem.m + is_free(problem.final_time)
        if size < q:
            raise ValueError(
                f"{kind}: {self.positions.shape[0]} nodes make {size} parameters, fewer than the "
                f"{q} endpoint constraints; give at least {-(-q // problem.m) + 1} nodes."
            )

    def __call__(self, problem: Problem, guess: Any) -> Extremal:
        frozen, positions = jax.lax.stop_gradient((problem, self.positions))
        of_u = _control_units(frozen)
        if guess is None:
            begin = _starts(frozen, positions, of_u, self.starts, self.seed)
        else:
            begin = jax.lax.stop_gradient(self._from_guess(frozen, positions, guess))[None]
        units = jax.vmap(functools.partial(_units, frozen, positions, of_u, self.degree))(begin)

        def attempt(a: Array, units: Units) -> tuple[KKTPoint, Array, Array, Array]:
            args = (frozen, positions)
            found = local_minimum(self._values(units), a / units.a, args, _ITERATIONS)
            return *found, self._values(units)(found[0].a, args)[0] * units.f

        zs, errors, minimal, costs = jax.lax.stop_gradient(jax.vmap(attempt)(begin, units))
        converged = (errors < _FOUND) & jnp.isfinite(costs)
        cheapest = jnp.argmin(jnp.where(converged, costs, jnp.inf))
        best = jnp.where(jnp.any(converged), cheapest, jnp.argmin(errors))
        z, units = jax.tree_util.tree_map(lambda v: v[best], (zs, units))
        values, args = self._values(units), (problem, self.positions)
        z = polished(values, z, args)
        error = residual(values, z, args)
        extremal = parametric_extremal(
            problem,
            self.positions,
            z.a * units.a,
            z.nu * units.f / units.c,
            degree=self.degree,
            residual=error,
        )
        extremal = differentiable_if(error <= _TOLERANCE, extremal, problem)
        result = RESULTS.where(minimal[best], RESULTS.successful, RESULTS.not_minimising)
        result = RESULTS.where(_within_bounds(extremal), result, RESULTS.bounds_violated)
        result = RESULTS.where(error <= _TOLERANCE, result, RESULTS.parameters_not_found)
        return eqx.tree_at(lambda e: e.result, extremal, result)

    def _values(self, units: "Units") -> Any:
        """Scaled cost and constraints, of scaled parameters."""

        def values(a: Array, args: tuple[Problem, Array]) -> tuple[Array, Array]:
            problem, positions = args
            start = par.from_the_start(problem, a.dtype)
            f, c, _ = par.outcome(problem, positions, a * units.a, start, self.degree)
            return f / units.f, c / units.c

        return values

    def _from_guess(self, problem: Problem, positions: Array, guess: Any) -> Float[Array, " p"]:
        """Parameters of `guess`: an Extremal, or controls at the nodes (k, m)."""
        if isinstance(guess, Extremal):
            t = guess.t[0] + positions * (guess.t[-1] - guess.t[0])
            return par.pack(problem, jax.vmap(lambda t: guess.point(t).u)(t), guess.t[-1])
        controls = jnp.asarray(guess, positions.dtype)
        if controls.shape != (positions.shape[0], problem.m):
            raise ValueError(
                f"guess has shape {controls.shape}; give an Extremal, or the controls at the "
                f"nodes, shape {(positions.shape[0], problem.m)}."
            )
        return par.pack(problem, controls, start_value(problem.final_time))


class Units(NamedTuple):
    """Units of parameters, cost and constraints."""

    a: Float[Array, " p"]
    f: Float[Array, ""]
    c: Float[Array, " q"]


def _control_units(problem: Problem) -> Float[Array, " m"]:
    """The `natural_units` of the controls, on a straight line between the nearest ends."""
    dtype = jnp.result_type(float)
    t0 = jnp.asarray(problem.initial_time, dtype)
    tf = jnp.asarray(start_value(problem.final_time), dtype)
    x0, xf = nearest_ends(problem, t0, tf)
    u = start_control(problem, dtype)[None, None]
    return natural_units(problem, jnp.stack([t0, tf]), x0, xf[None, None], u)[1]


def _units(
    problem: Problem, positions: Array, of_u: Float[Array, " m"], degree: int, a: Array
) -> Units:
    """Units: of a free final time its value, of controls without bounds `of_u`, of the others 1; of
    cost and constraints their largest slopes at the parameters `a`."""
    lo, hi = bounds_of(problem.control_bounds, problem.m, a.dtype)
    of_u = jnp.where(jnp.isfinite(lo) & jnp.isfinite(hi), 1.0, of_u)
    size = jnp.tile(of_u, positions.shape[0])
    if is_free(problem.final_time):
        size = jnp.append(size, positive(jnp.abs(a[-1])))
    start = par.from_the_start(problem, a.dtype)
    outcome = lambda a: par.outcome(problem, positions, a * size, start, degree)[:2]
    f, c = jax.jacfwd(outcome)(a / size)
    usable = lambda s: jnp.where(jnp.isfinite(s) & (s > 0), s, 1.0)
    return Units(size, usable(jnp.max(jnp.abs(f))), usable(jnp.max(jnp.abs(c), axis=1)))


def _starts(
    problem: Problem, positions: Array, of_u: Float[Array, " m"], starts: int, seed: int
) -> Float[Array, "start p"]:
    """A constant control, then random straight ones over horizons within twice the guess."""
    dtype, m = positions.dtype, problem.m
    k_u, k_t = jax.random.split(jax.random.key(seed))
    draws = jax.random.uniform(k_u, (starts, 2, m), dtype, -1.0, 1.0).at[0].set(0.0)
    lo, hi = bounds_of(problem.control_bounds, m, dtype)
    middle, start = jnp.clip(0.0, lo, hi), start_control(problem, dtype)
    unbounded = ~(jnp.isfinite(lo) & jnp.isfinite(hi))
    centre = jnp.where(unbounded, middle + (start - middle) * of_u, start)
    ends = control_ends(problem, draws, centre, _HALF * of_u)
    controls = ends[:, :1] + positions[None, :, None] * (ends[:, 1:] - ends[:, :1])
    t0 = jnp.asarray(problem.initial_time, dtype)
    tf = jnp.asarray(start_value(problem.final_time), dtype)
    factor = jnp.exp(jax.random.uniform(k_t, (starts,), dtype, -_SPREAD, _SPREAD)).at[0].set(1.0)
    return jax.vmap(lambda u, s: par.pack(problem, u, t0 + s * (tf - t0)))(controls, factor)


def _within_bounds(extremal: Extremal) -> Array:
    """Whether state and control keep within their bounds, which are not enforced."""
    e = extremal
    _, state, control = oversteps(e.problem, e.t, e.x, e.u, e.sizes())
    return jnp.all(state <= _WITHIN) & jnp.all(control <= _WITHIN)


def _check_positions(positions: np.ndarray) -> None:
    steps = np.diff(positions)
    if not np.all(steps > 0):
        i = int(np.argmax(~(steps > 0)))
        how = "repeats" if steps[i] == 0 else "does not ascend"
        raise ValueError(
            f"PiecewiseLinear: nodes[{i}:{i + 2}] = {positions[i : i + 2].tolist()} {how}; give "
            "ascending positions, each once."
        )
    if positions[0] != 0 or positions[-1] != 1:
        raise ValueError(
            f"PiecewiseLinear: nodes run from {positions[0]} to {positions[-1]}; the first must be "
            "0 (the initial time) and the last 1 (the final one)."
        )
