"""Problem P on a mesh, as a nonlinear program with a structure: review, problem B^N of eq. (21).

Every function here is evaluated node by node; nothing assembles a matrix of the whole.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.nominal.mesh import Collocation, collocation
from jaxguide.problem import (
    Free,
    Problem,
    bounds_of,
    initial_values,
    initially_free,
    is_free,
    parameter_names,
    with_parameters,
)


class Primal(NamedTuple):
    """The unknowns, scaled. Segments share their ends: `x` holds what follows each one's first."""

    x0: Float[Array, " n"]
    x: Float[Array, "segment after n"]
    u: Float[Array, "segment node m"]
    times: Float[Array, " clock"]  # t0, tf
    p: Float[Array, " parameter"]  # static parameters
    path: Float[Array, "segment node h"]  # slacks: what the path constraints should equal
    end: Float[Array, " q"]  # slacks of the endpoint constraints


class Rows(NamedTuple):
    """One number for each equality constraint: its residual c, which vanishes, or its multiplier y
    in the scaled Lagrangian f + y^T c."""

    defect: Float[Array, "segment row n"]
    path: Float[Array, "segment node h"]
    end: Float[Array, " q"]


class Scale(NamedTuple):
    """Designer units: user units = scale times the solver's."""

    x: Float[Array, " n"]
    u: Float[Array, " m"]
    t: Float[Array, ""]
    p: Float[Array, " parameter"]
    path: Float[Array, " h"]
    end: Float[Array, " q"]
    objective: Float[Array, ""]


class Nodes(NamedTuple):
    """(dt/dtau f, w dt/dtau F, h) at every node, and first derivatives, with respect to
    (x, u, t_a, t_b, p): the ends of the node's segment and the static parameters."""

    value: Float[Array, "segment node out"]
    jacobian: Float[Array, "segment node out in"]


class Ends(NamedTuple):
    """As `Nodes`, of (E, e) with respect to (x0, times, p, xf)."""

    value: Float[Array, " out"]
    jacobian: Float[Array, "out in"]


class Sizes(NamedTuple):
    n: int
    m: int
    parameters: int
    path: int
    end: int
    segments: int
    nodes: int
    after: int  # support points of a segment that follow its first


class Transcription(eqx.Module):
    """A Problem on `fractions` (S + 1) of its horizon, `points` nodes of `family` a segment."""

    problem: Problem
    scale: Scale
    fractions: Float[Array, " edge"]
    family: str = eqx.field(static=True)
    points: int = eqx.field(static=True)

    @property
    def rule(self) -> Collocation:
        return collocation(self.family, self.points)

    @property
    def sizes(self) -> Sizes:
        problem = self.problem
        path, end = constraint_counts(problem)
        return Sizes(
            problem.n,
            problem.m,
            self.scale.p.shape[0],
            path,
            end,
            self.fractions.shape[0] - 1,
            self.points,
            len(self.rule.support) - 1,
        )

    @property
    def clocks(self) -> Float[Array, "segment two two"]:
        """(t_a, t_b) of every segment from (t0, tf)."""
        row = lambda s: jnp.stack([1 - s, s], axis=-1)
        return jnp.stack([row(self.fractions[:-1]), row(self.fractions[1:])], axis=1)

    @property
    def units(self) -> Primal:
        """What one of each unknown is in user units."""
        s = self.scale
        nodal = lambda a: a[None, None]
        return Primal(s.x, nodal(s.x), nodal(s.u), s.t[None], s.p, nodal(s.path), s.end)

    def starts(self, w: Primal) -> Float[Array, "segment n"]:
        """State at the start of every segment."""
        return jnp.concatenate([w.x0[None], w.x[:-1, -1]])

    def support(self, w: Primal) -> Float[Array, "segment support n"]:
        return jnp.concatenate([self.starts(w)[:, None], w.x], axis=1)

    def inputs(self, w: Primal) -> Float[Array, "segment node in"]:
        """(x, u, t_a, t_b, p) at every node."""
        rule, size = self.rule, self.sizes
        x = self.support(w)[:, rule.first : rule.first + self.points]
        at = jnp.concatenate(
            [self.clocks @ w.times, jnp.broadcast_to(w.p, (size.segments, len(w.p)))], axis=1
        )
        at = jnp.broadcast_to(at[:, None], (size.segments, self.points, at.shape[1]))
        return jnp.concatenate([x, w.u, at], axis=2)

    def node(self, tau: Array, weight: Array, q: Float[Array, " in"]) -> Float[Array, " out"]:
        """(dt/dtau f, w dt/dtau F, h) at one node, scaled."""
        n, m, scale = self.problem.n, self.problem.m, self.scale
        x, u = q[:n] * scale.x, q[n : n + m] * scale.u
        ta, tb = q[n + m] * scale.t, q[n + m + 1] * scale.t
        problem = chosen(self.problem, q[n + m + 2 :] * scale.p)
        t = (ta * (1 - tau) + tb * (1 + tau)) / 2  # eq. (5)
        rate = (tb - ta) / 2
        f = rate * problem.dynamics(t, x, u) / scale.x
        cost = weight * rate * problem.running_cost(t, x, u) / scale.objective
        return jnp.concatenate([f, cost[None], problem.path_constraints(t, x, u) / scale.path])

    def end(self, b: Float[Array, " in"]) -> Float[Array, " out"]:
        """(E, e) from (x0, times, p, xf), scaled."""
        n, scale = self.problem.n, self.scale
        x0, times, p, xf = b[:n], b[n : n + 2], b[n + 2 : -n], b[-n:]
        problem = chosen(self.problem, p * scale.p)
        at = (x0 * scale.x, xf * scale.x, times[0] * scale.t, times[1] * scale.t)
        cost = problem.endpoint_cost(*at) / scale.objective
        return jnp.concatenate([cost[None], problem.endpoint_constraints(*at) / scale.end])

    def end_inputs(self, w: Primal) -> Float[Array, " in"]:
        return jnp.concatenate([w.x0, w.times, w.p, w.x[-1, -1]])

    @property
    def _taus(self) -> tuple[Array, Array]:
        rule, dtype = self.rule, self.fractions.dtype
        return jnp.asarray(rule.nodes, dtype), jnp.asarray(rule.w, dtype)

    def values(self, w: Primal) -> tuple[Float[Array, "segment node out"], Float[Array, " end"]]:
        over = jax.vmap(jax.vmap(self.node), in_axes=(None, None, 0))
        return over(*self._taus, self.inputs(w)), self.end(self.end_inputs(w))

    def objective_and_residual(self, w: Primal, values: Any = None) -> tuple[Array, Rows]:
        """J of problem P and the constraints, scaled."""
        node, end = self.values(w) if values is None else values
        n, rule, dtype = self.problem.n, self.rule, self.fractions.dtype
        A, B = jnp.asarray(rule.A, dtype), jnp.asarray(rule.B, dtype)
        defect = jnp.einsum("rp,spn->srn", A, self.support(w))
        defect = defect - jnp.einsum("rk,skn->srn", B, node[:, :, :n])
        residual = Rows(defect, node[:, :, n + 1 :] - w.path, end[1:] - w.end)
        return jnp.sum(node[:, :, n]) + end[0], residual

    def derivatives(self, w: Primal) -> tuple[Nodes, Ends]:
        """Values and Jacobians, node by node."""
        both = lambda f: lambda *a: (f(*a), f(*a))
        node = jax.jacfwd(both(self.node), argnums=2, has_aux=True)
        over = jax.vmap(jax.vmap(node), in_axes=(None, None, 0))
        jacobian, value = over(*self._taus, self.inputs(w))
        end_jacobian, end_value = jax.jacfwd(both(self.end), has_aux=True)(self.end_inputs(w))
        return Nodes(value, jacobian), Ends(end_value, end_jacobian)

    def node_weights(self, y: Rows) -> Float[Array, "segment node out"]:
        """What multiplies each of `Nodes.value` in the Lagrangian."""
        B = jnp.asarray(self.rule.B, y.defect.dtype)
        f = -jnp.einsum("rk,srn->skn", B, y.defect)
        return jnp.concatenate([f, jnp.ones_like(f[:, :, :1]), y.path], axis=2)

    def hessians(
        self, w: Primal, y: Rows
    ) -> tuple[Float[Array, "segment node in in"], Float[Array, "end end"]]:
        """Second derivatives of the Lagrangian, node by node, and of its endpoint part."""
        weights = self.node_weights(y)
        node = lambda tau, w, q, c: jnp.dot(c, self.node(tau, w, q))
        over = jax.vmap(jax.vmap(hessian(node, 2)), in_axes=(None, None, 0, 0))
        at_nodes = over(*self._taus, self.inputs(w), weights)
        c = jnp.concatenate([jnp.ones_like(y.end, shape=1), y.end])
        return at_nodes, hessian(lambda b: jnp.dot(c, self.end(b)), 0)(self.end_inputs(w))


def hessian(f: Any, argnum: int) -> Any:
    """Forward over reverse, symmetric to the last bit."""
    full = jax.jacfwd(jax.grad(f, argnums=argnum), argnums=argnum)

    def symmetric(*args: Any) -> Array:
        h = full(*args)
        return (h + h.T) / 2

    return symmetric


def constraint_counts(problem: Problem) -> tuple[int, int]:
    """Numbers of path and endpoint constraints."""
    dtype = jnp.result_type(float)
    t, x, u = (jax.ShapeDtypeStruct(s, dtype) for s in ((), (problem.n,), (problem.m,)))
    problem = chosen(problem, None)
    path = jax.eval_shape(problem.path_constraints, t, x, u).shape[0]
    return path, jax.eval_shape(problem.endpoint_constraints, x, x, t, t).shape[0]


class WithIntegrals(Problem):
    """`inner` with each of its integrals as a state that starts at zero and ends within bounds."""

    inner: Problem

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        x = x[: self.inner.n]
        return jnp.concatenate([self.inner.dynamics(t, x, u), self.inner.integrands(t, x, u)])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.running_cost(t, x[: self.inner.n], u)

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.path_constraints(t, x[: self.inner.n], u)

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return self.inner.endpoint_cost(x0[: self.inner.n], xf[: self.inner.n], t0, tf)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        n = self.inner.n
        own = self.inner.endpoint_constraints(x0[:n], xf[:n], t0, tf)
        return jnp.concatenate([own, xf[n:]])


def with_integrals(problem: Problem) -> Problem:
    """`problem`, or a WithIntegrals of it where it has integral constraints."""
    dtype = jnp.result_type(float)
    t, x, u = (jax.ShapeDtypeStruct(s, dtype) for s in ((), (problem.n,), (problem.m,)))
    count = jax.eval_shape(with_parameters(problem, None).integrands, t, x, u).shape[0]
    if not count:
        return problem
    _, q = constraint_counts(problem)
    join = lambda a, b: tuple(jnp.concatenate([u, v]) for u, v in zip(a, b, strict=True))
    states = bounds_of(problem.state_bounds, problem.n, dtype)
    ends = bounds_of(problem.endpoint_bounds, q, dtype)
    integrals = bounds_of(problem.integral_bounds, count, dtype)
    start = problem.initial_state
    if not isinstance(start, (tuple, list)):
        free = [Free() if start is None else start] * problem.n
        start = free if start is None or is_free(start) else [start[i] for i in range(problem.n)]
    return WithIntegrals(
        inner=problem,
        state_names=problem.state_names + tuple(f"integral {i}" for i in range(count)),
        control_names=problem.control_names,
        initial_time=problem.initial_time,
        final_time=problem.final_time,
        initial_state=(*start, *(jnp.zeros((), dtype),) * count),
        state_bounds=join(states, bounds_of((-jnp.inf, jnp.inf), count, dtype)),
        control_bounds=problem.control_bounds,
        endpoint_bounds=join(ends, integrals),
        path_bounds=problem.path_bounds,
    )


def parameters(problem: Problem) -> list[Free]:
    """The static parameters left to the solver."""
    own = problem.inner if isinstance(problem, WithIntegrals) else problem
    return [getattr(own, k) for k in parameter_names(own)]


def chosen(problem: Problem, p: Any) -> Problem:
    """`with_parameters`, of the problem inside a WithIntegrals too."""
    if not isinstance(problem, WithIntegrals):
        return with_parameters(problem, p)
    return eqx.tree_at(lambda q: q.inner, problem, with_parameters(problem.inner, p))


class Bounds(NamedTuple):
    """Of every entry of a Primal; equal where an entry is given."""

    lo: Primal
    hi: Primal


def bounds(program: Transcription) -> Bounds:
    """Bounds, scaled. Entries of `x0` and `times` that are given have both equal."""
    problem, scale, size = program.problem, program.scale, program.sizes
    dtype = program.fractions.dtype
    over = lambda b, *lead: jnp.broadcast_to(b, (*lead, *b.shape))
    number = lambda v: jnp.asarray(v, dtype)

    def scalar(entry: Any) -> tuple[Array, Array]:
        if is_free(entry):
            return number(entry.lo), number(entry.hi)
        return number(entry), number(entry)

    states = bounds_of(problem.state_bounds, size.n, dtype)
    start = initial_values(problem, dtype)
    x0 = [start, start]
    free = jnp.asarray(initially_free(problem))
    if any(initially_free(problem)):
        entries = problem.initial_state
        for i, pick in enumerate((lambda e: e.lo, lambda e: e.hi)):
            if isinstance(entries, (tuple, list)):
                own = jnp.stack([number(pick(e) if is_free(e) else 0.0) for e in entries])
            else:
                own = states[i] if entries is None else over(number(pick(entries)), size.n)
            tighter = jnp.maximum if i == 0 else jnp.minimum
            x0[i] = jnp.where(free, tighter(own, states[i]), start)
    times = [scalar(problem.initial_time), scalar(problem.final_time)]
    p = [scalar(v) for v in parameters(problem)]
    controls = bounds_of(problem.control_bounds, size.m, dtype)
    path = bounds_of(problem.path_bounds, size.path, dtype)
    end = bounds_of(problem.endpoint_bounds, size.end, dtype)

    def side(i: int) -> Primal:
        return Primal(
            x0[i] / scale.x,
            over(states[i] / scale.x, size.segments, size.after),
            over(controls[i] / scale.u, size.segments, size.nodes),
            jnp.stack([t[i] for t in times]) / scale.t,
            (jnp.stack([v[i] for v in p]) if p else jnp.zeros(0, dtype)) / scale.p,
            over(path[i] / scale.path, size.segments, size.nodes),
            end[i] / scale.end,
        )

    return Bounds(side(0), side(1))


def node_times(program: Transcription, w: Primal, at: np.ndarray) -> Float[Array, "segment k"]:
    """User times of the points `at` (tau) of every segment."""
    tau = jnp.asarray(at, program.fractions.dtype)
    ends = program.clocks @ w.times * program.scale.t
    return (ends[:, :1] * (1 - tau)[None] + ends[:, 1:] * (1 + tau)[None]) / 2
