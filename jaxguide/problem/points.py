"""A Problem's functions at one point of a mesh, scaled, and the small programs that evaluate them
at many: of any mesh, for they know nothing of it.

**Source:** Ross & Karpenko, review (2012): problem P, eq. (2).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, on_numpy, xp
from jaxguide.host.compilation import compiled
from jaxguide.host.remembered import remembered
from jaxguide.problem.counts import count, endpoint_count
from jaxguide.problem.parameters import Path, parameters, placed_at, with_parameters
from jaxguide.problem.statement import Problem, start_value

# Points that a program of the host takes at once. More call it again, fewer repeat the last, so
# that one program serves every mesh. A choice: small problems need no more for a first mesh.
_AT_ONCE = 128


class Scale(NamedTuple):
    """Designer units: a quantity in user units is its scale times the solver's number."""

    x: Float[Array, " n"]
    u: Float[Array, " m"]
    t: Float[Array, ""]
    p: Float[Array, " parameter"]
    path: Float[Array, " h"]
    end: Float[Array, " q"]
    objective: Float[Array, ""]


class PointFunctions(eqx.Module):
    """`problem` in the units of `scale`. Numbers stand at the `paths` of its static parameters,
    whatever they are: one program serves the search and the extremal that it finds."""

    problem: Problem
    scale: Scale
    paths: tuple[Path, ...] = eqx.field(static=True)

    def node(self, tau: Array, weight: Array, q: Float[Array, " in"]) -> Float[Array, " out"]:
        """(dt/dtau f, w dt/dtau F, h) at one node, scaled, for q = (x, u, t_a, t_b, p)."""
        n, m, scale = self.problem.n, self.problem.m, self.scale
        x, u = q[:n] * scale.x, q[n : n + m] * scale.u
        ta, tb = q[n + m] * scale.t, q[n + m + 1] * scale.t
        problem = placed_at(self.problem, self.paths, q[n + m + 2 :] * scale.p)
        t = (ta * (1 - tau) + tb * (1 + tau)) / 2  # review, eq. (5)
        rate = (tb - ta) / 2
        f = rate * problem.dynamics(t, x, u) / scale.x
        cost = weight * rate * problem.running_cost(t, x, u) / scale.objective
        return jnp.concatenate([f, cost[None], problem.path_constraints(t, x, u) / scale.path])

    def end(self, b: Float[Array, " in"]) -> Float[Array, " out"]:
        """(E, e), scaled, for b = (x0, t0, tf, p, xf)."""
        n, scale = self.problem.n, self.scale
        x0, times, p, xf = b[:n], b[n : n + 2], b[n + 2 : -n], b[-n:]
        problem = placed_at(self.problem, self.paths, p * scale.p)
        at = (x0 * scale.x, xf * scale.x, times[0] * scale.t, times[1] * scale.t)
        cost = problem.endpoint_cost(*at) / scale.objective
        return jnp.concatenate([cost[None], problem.endpoint_constraints(*at) / scale.end])


def point_functions(problem: Problem, scale: Scale) -> PointFunctions:
    """Those of a Problem whose parameters are still `jg.Free`, or were chosen already."""
    return PointFunctions(with_parameters(problem, None), scale, problem.parameter_paths())


def point_values(functions: PointFunctions, points: tuple, ends: tuple) -> tuple[Array, Array]:
    """Values at `points` (tau, weight, input) and at the ends."""
    return jax.vmap(functions.node)(*points), functions.end(*ends)


def point_derivatives(functions: PointFunctions, points: tuple, ends: tuple) -> tuple[Any, Any]:
    """Values and Jacobians at `points` (tau, weight, input) and at the ends."""
    twice = lambda f: lambda *a: (lambda v: (v, v))(f(*a))
    jacobian, value = jax.vmap(jax.jacfwd(twice(functions.node), 2, has_aux=True))(*points)
    end_jacobian, end_value = jax.jacfwd(twice(functions.end), has_aux=True)(*ends)
    return (value, jacobian), (end_value, end_jacobian)


def point_hessians(functions: PointFunctions, points: tuple, ends: tuple) -> tuple[Array, Array]:
    """Hessians of the functions' sum with `weights`, the last of `points` and of `ends`."""
    node = lambda tau, w, q, c: jnp.dot(c, functions.node(tau, w, q))
    end = lambda b, c: jnp.dot(c, functions.end(b))
    return jax.vmap(hessian(node, 2))(*points), hessian(end, 0)(*ends)


def hessian(f: Any, argnum: int) -> Any:
    """Second derivative of the scalar `f` by one argument, forward over reverse, symmetric to the
    last bit."""
    full = jax.jacfwd(jax.grad(f, argnums=argnum), argnums=argnum)

    def symmetric(*args: Any) -> Array:
        h = full(*args)
        return (h + h.T) / 2

    return symmetric


def at_points(program: Any, functions: PointFunctions, points: tuple, ends: tuple) -> Any:
    """The result of a `program` above; on the host `_AT_ONCE` points at a time."""
    if not on_numpy(points, ends):
        return program(functions, points, ends)
    size = len(points[0])
    short = -size % _AT_ONCE
    full = [np.concatenate([a, np.broadcast_to(a[-1:], (short, *a.shape[1:]))]) for a in points]
    parts = [
        compiled(program, True)(functions, tuple(a[k : k + _AT_ONCE] for a in full), ends)
        for k in range(0, size, _AT_ONCE)
    ]
    nodes, end = zip(*jax.device_get(parts), strict=True)
    return jax.tree_util.tree_map(lambda *a: np.concatenate(a)[:size], *nodes), end[0]


class Slopes(NamedTuple):
    """Dynamics, running cost and path constraints at points of a trajectory in user units, and
    their Jacobians by (x, u, t)."""

    f: Float[Array, "point n"]
    cost: Float[Array, " point"]
    path: Float[Array, "point p"]
    f_by: Float[Array, "point n in"]
    cost_by: Float[Array, "point in"]
    path_by: Float[Array, "point p in"]


def rates(
    problem: Problem, t: Float[Array, " point"], x: Float[Array, "point n"], u: Array
) -> tuple[Float[Array, "point n"], Float[Array, " point"], Float[Array, "point p"]]:
    """Dynamics, running cost and path constraints at points of a trajectory, in user units; of
    `jg.Free` parameters, where the search for them starts."""
    if not on_numpy(t, x, u):
        stated, over = with_parameters(problem, None), lambda f: jax.vmap(f)(t, x, u)
        return over(stated.dynamics), over(stated.running_cost), over(stated.path_constraints)
    functions, points, ends, rate = _as_points(problem, t, x, u)
    value, _ = at_points(point_values, functions, points, ends)
    return value[:, : problem.n] / rate, value[:, problem.n] / rate[:, 0], value[:, problem.n + 1 :]


def slopes(
    problem: Problem, t: Float[Array, " point"], x: Float[Array, "point n"], u: Array
) -> Slopes:
    """`rates` with their Jacobians."""
    n, m = problem.n, problem.m
    if not on_numpy(t, x, u):
        stated, along = with_parameters(problem, None), xp.concatenate([x, u, t[:, None]], axis=1)

        def both(q: Array) -> tuple[Any, Any]:
            at = (q[-1], q[:n], q[n:-1])
            value = (stated.dynamics(*at), stated.running_cost(*at), stated.path_constraints(*at))
            return value, value

        by, value = jax.vmap(jax.jacfwd(both, has_aux=True))(along)
        return Slopes(*value, *by)
    functions, points, ends, rate = _as_points(problem, t, x, u)
    (value, jacobian), _ = at_points(point_derivatives, functions, points, ends)
    # t is t_a, and dt/dtau does not change with t_a and t_b alike.
    by: Any = np.concatenate(
        [jacobian[:, :, : n + m], jacobian[:, :, n + m : n + m + 2].sum(axis=2, keepdims=True)],
        axis=2,
    )
    return Slopes(
        value[:, :n] / rate, value[:, n] / rate[:, 0], value[:, n + 1 :],
        by[:, :n] / rate[:, :, None], by[:, n] / rate, by[:, n + 1 :],
    )  # fmt: skip


def integrand_slopes(
    problem: Problem, t: Float[Array, " point"], x: Float[Array, "point n"], u: Array
) -> tuple[Float[Array, "point r"], Float[Array, "point r in"]]:
    """The integrands and their Jacobians by (x, u, t)."""
    along = xp.concatenate([x, u, t[:, None]], axis=1)
    if not (r := count(problem, "integrands")):
        return xp.zeros_like(x, shape=(len(t), 0)), xp.zeros_like(
            x, shape=(len(t), r, along.shape[1])
        )
    if not on_numpy(along):
        return _integrands(problem, along)
    return jax.device_get(compiled(_integrands, True)(problem, along))


def _integrands(problem: Problem, along: Float[Array, "point in"]) -> Any:
    n, twice, problem = problem.n, lambda v: (v, v), with_parameters(problem, None)
    both = lambda q: twice(problem.integrands(q[-1], q[:n], q[n:-1]))
    by, value = jax.vmap(jax.jacfwd(both, has_aux=True))(along)
    return value, by


def control_curvature(
    problem: Problem,
    t: Float[Array, " point"],
    x: Float[Array, "point n"],
    u: Array,
    costate: Array,
) -> Float[Array, "point m m"]:
    """H_uu of H = F + lambda^T f."""
    n, m = problem.n, problem.m
    if not on_numpy(t, x, u, costate):
        known = with_parameters(problem, None)

        def h(t: Array, x: Array, u: Array, costate: Array) -> Array:
            return known.running_cost(t, x, u) + jnp.dot(costate, known.dynamics(t, x, u))

        return jax.vmap(jax.hessian(h, argnums=2))(t, x, u, costate)
    functions, points, ends, rate = _as_points(problem, t, x, u)
    path = np.zeros((len(t), len(functions.scale.path)))
    factors = np.concatenate([costate / rate, 1 / rate, path], axis=1)
    none = np.zeros(1 + len(functions.scale.end))
    at, _ = at_points(point_hessians, functions, (*points, factors), (*ends, none))
    return at[:, n : n + m, n : n + m]


class EndSlopes(NamedTuple):
    """Endpoint cost and constraints (E, e), and their Jacobians by (x0, t0, tf, xf)."""

    value: Float[Array, " out"]
    by: Float[Array, "out in"]


def end_slopes(problem: Problem, x0: Array, xf: Array, t0: Array, tf: Array) -> EndSlopes:
    """Endpoint functions and their Jacobians, in user units."""
    n = problem.n
    if not on_numpy(x0, xf, t0, tf):
        known = with_parameters(problem, None)

        def both(b: Array) -> tuple[Array, Array]:
            at = (b[:n], b[n + 2 :], b[n], b[n + 1])
            cost, e = known.endpoint_cost(*at), known.endpoint_constraints(*at)
            value = jnp.concatenate([jnp.reshape(cost, 1), e])
            return value, value

        by, value = jax.jacfwd(both, has_aux=True)(jnp.concatenate([x0, t0[None], tf[None], xf]))
        return EndSlopes(value, by)
    t = np.array([t0, tf])
    functions, points, ends, _ = _as_points(
        problem, t, np.stack([x0, xf]), np.zeros((2, problem.m))
    )
    _, (value, by) = at_points(point_derivatives, functions, points, ends)
    return EndSlopes(value, np.delete(by, np.s_[n + 2 : n + 2 + len(functions.scale.p)], axis=1))


def _as_points(problem: Problem, t: Any, x: Any, u: Any) -> Any:
    """Functions in user units, and points at the starts of segments as long as the times are large;
    with dt/dtau of each."""
    size = np.max(np.abs(t), initial=0.0)
    after = t + (size if size > 0 else 1.0)
    one, p = _user_units(problem)
    q = [x, u, t[:, None], after[:, None], np.broadcast_to(p, (len(t), len(p)))]
    start, weight = np.full_like(t, -1.0), np.ones_like(t)
    ends = np.concatenate([x[0], t[[0, -1]], p, x[-1]])
    points = (start, weight, np.concatenate(q, axis=1))
    return point_functions(problem, one), points, (ends,), ((after - t) / 2)[:, None]


@remembered
def _user_units(problem: Problem) -> tuple[Scale, Float[np.ndarray, " k"]]:
    return unit_scale(problem), start_parameters(problem)


def start_parameters(problem: Problem) -> Float[np.ndarray, " k"]:
    """The static parameters where the search for them starts."""
    entries = parameters(problem)
    return np.array([float(np.asarray(start_value(v))) for v in entries], jnp.result_type(float))


def unit_scale(problem: Problem) -> Scale:
    """User units as they are: every scale 1."""
    one = xp.ones((), jnp.result_type(float))
    many = lambda k: xp.ones(k, one.dtype)
    return Scale(
        many(problem.n), many(problem.m), one, many(len(parameters(problem))),
        many(count(problem, "path_constraints")), many(endpoint_count(problem)), one,
    )  # fmt: skip
