"""Problem P on a mesh, as a nonlinear program with a structure.

Every function here is evaluated node by node; nothing assembles a matrix of the whole.

**Source:** Ross & Karpenko, review (2012): problem P, eq. (2), as problem B^N, eq. (21).
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.nominal.direct.collocation import Collocation, collocation
from jaxguide.nominal.direct.unknowns import Arcwise, Counts, Equations, Primal, Scale
from jaxguide.problem import Problem, is_free, with_parameters
from jaxguide.spectral import NodeFamily, legendre_matrix


class Nodes(NamedTuple):
    """(dt/dtau f, w dt/dtau F, h) at every node, and first derivatives with respect to
    (x, u, t_a, t_b, p), where t_a and t_b are the end times of the node's segment and p the static
    parameters. All scaled."""

    value: Float[Array, "segment node out"]
    jacobian: Float[Array, "segment node out in"]


class Ends(NamedTuple):
    """Endpoint cost and constraints (E, e), and first derivatives with respect to
    (x0, times, p, xf). All scaled."""

    value: Float[Array, " out"]
    jacobian: Float[Array, "out in"]


class Transcription(eqx.Module):
    """A Problem on S segments of `points` nodes each.

    - `scale`: designer units of everything.
    - `edges`: break points, each a linear combination of the times t0, tf and free knots.
    - `family`: of the nodes, see `collocation`.
    - `arcwise`: the known structure of each segment's arc.
    - `log`: print the optimiser's iterations.
    """

    problem: Problem
    scale: Scale
    edges: Float[Array, "edge clock"]
    family: str | NodeFamily = eqx.field(static=True)  # name or family
    points: int = eqx.field(static=True)
    arcwise: "Arcwise | None" = None
    log: bool = eqx.field(static=True, default=False)

    @property
    def rule(self) -> Collocation:
        """Nodes, weights and defect matrices of one segment."""
        return collocation(self.family, self.points)

    @property
    def counts(self) -> Counts:
        """How many unknowns and equations of each kind there are."""
        problem, scale = self.problem, self.scale
        return Counts(
            problem.n,
            problem.m,
            scale.p.shape[0],
            scale.path.shape[0],
            scale.end.shape[0],
            self.edges.shape[0] - 1,
            self.points,
            len(self.rule.support) - 1,
            self.edges.shape[1],
        )

    @property
    def clocks(self) -> Float[Array, "segment two clock"]:
        """The linear map from the times to (t_a, t_b), the end times of every segment."""
        return jnp.stack([self.edges[:-1], self.edges[1:]], axis=1)

    @property
    def dtype(self) -> Any:
        """The type of every floating number in the program."""
        return self.edges.dtype

    @property
    def order(self) -> Float[np.ndarray, "row clock"]:
        """Rows that must stay positive on the times: see `clock_order`."""
        return clock_order(self.problem, self.edges.shape[1])

    @property
    def units(self) -> Primal:
        """The designer unit of every unknown, in user units."""
        s = self.scale
        nodal = lambda a: a[None, None]
        return Primal(s.x, nodal(s.x), nodal(s.u), s.t[None], s.p, nodal(s.path), s.end)

    def shaped(self, vector: Array) -> Primal:
        """`flattened` undone."""
        s = self.counts
        nodal = (s.segments, s.nodes)
        shapes = (
            (s.n,), (s.segments, s.after, s.n), (*nodal, s.m), (s.times,), (s.parameters,),
            (*nodal, s.path), (s.end,),
        )  # fmt: skip
        cuts = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
        parts = zip(jnp.split(vector, cuts), shapes, strict=True)
        return Primal(*(part.reshape(shape) for part, shape in parts))

    def starts(self, w: Primal) -> Float[Array, "segment n"]:
        """State at the start of every segment."""
        return jnp.concatenate([w.x0[None], w.x[:-1, -1]])

    def support(self, w: Primal) -> Float[Array, "segment support n"]:
        """States at all support points of every segment."""
        return jnp.concatenate([self.starts(w)[:, None], w.x], axis=1)

    def inputs(self, w: Primal) -> Float[Array, "segment node in"]:
        """(x, u, t_a, t_b, p) at every node."""
        rule, counts = self.rule, self.counts
        x = self.support(w)[:, rule.first : rule.first + self.points]
        at = jnp.concatenate(
            [self.clocks @ w.times, jnp.broadcast_to(w.p, (counts.segments, len(w.p)))], axis=1
        )
        at = jnp.broadcast_to(at[:, None], (counts.segments, self.points, at.shape[1]))
        return jnp.concatenate([x, w.u, at], axis=2)

    def node(self, tau: Array, weight: Array, q: Float[Array, " in"]) -> Float[Array, " out"]:
        """(dt/dtau f, w dt/dtau F, h) at one node, scaled; `q`: see `inputs`."""
        n, m, scale = self.problem.n, self.problem.m, self.scale
        x, u = q[:n] * scale.x, q[n : n + m] * scale.u
        ta, tb = q[n + m] * scale.t, q[n + m + 1] * scale.t
        problem = with_parameters(self.problem, q[n + m + 2 :] * scale.p)
        t = (ta * (1 - tau) + tb * (1 + tau)) / 2  # review, eq. (5)
        rate = (tb - ta) / 2
        f = rate * problem.dynamics(t, x, u) / scale.x
        cost = weight * rate * problem.running_cost(t, x, u) / scale.objective
        return jnp.concatenate([f, cost[None], problem.path_constraints(t, x, u) / scale.path])

    def end(self, b: Float[Array, " in"]) -> Float[Array, " out"]:
        """(E, e), scaled, and the differences of times that must stay positive; `b`: see
        `end_inputs`."""
        n, scale = self.problem.n, self.scale
        clock = self.edges.shape[1]
        x0, times, p, xf = b[:n], b[n : n + clock], b[n + clock : -n], b[-n:]
        problem = with_parameters(self.problem, p * scale.p)
        at = (x0 * scale.x, xf * scale.x, times[0] * scale.t, times[1] * scale.t)
        cost = problem.endpoint_cost(*at) / scale.objective
        e = problem.endpoint_constraints(*at) / scale.end[: scale.end.shape[0] - len(self.order)]
        return jnp.concatenate([cost[None], e, self.order @ times])

    def end_inputs(self, w: Primal) -> Float[Array, " in"]:
        """(x0, times, p, xf)."""
        return jnp.concatenate([w.x0, w.times, w.p, w.x[-1, -1]])

    @property
    def _nodes_and_weights(self) -> tuple[Array, Array]:
        rule, dtype = self.rule, self.dtype
        return jnp.asarray(rule.nodes, dtype), jnp.asarray(rule.w, dtype)

    @jax.jit  # traced once a program, like those below
    def values(self, w: Primal) -> tuple[Float[Array, "segment node out"], Float[Array, " end"]]:
        """`node` at every node, and `end`."""
        over = jax.vmap(jax.vmap(self.node), in_axes=(None, None, 0))
        return over(*self._nodes_and_weights, self.inputs(w)), self.end(self.end_inputs(w))

    def roughness(self, u: Float[Array, "segment node m"]) -> Float[Array, "segment node m"]:
        """Gradient, linear in u, of half the weighted squares of each control's upper Legendre
        coefficients. That term keeps a control smooth on a singular arc, where nothing else
        does."""
        if self.arcwise is None:
            return jnp.zeros_like(u)
        upper = legendre_matrix(jnp.asarray(self.rule.nodes, u.dtype))[self.points // 2 :]
        return jnp.einsum("sm,ij,sjm->sim", self.arcwise.smooth, upper.T @ upper, u)

    @jax.jit
    def objective_and_residual(
        self, w: Primal, values: Any = None
    ) -> tuple[Float[Array, ""], Equations]:
        """Objective J^N and constraints of problem B^N, scaled; `values`: those at `w`, if known.

        The inequalities of problem P hold by slacks, h - s_h = 0 and e - s_e = 0, whose bounds are
        those of h and e. The consistency parameter delta^N is zero here; `transforms.relaxed`
        states problem B^N for a positive one.

        **Source:** Ross & Karpenko, review (2012), eq. (21), for problem P of eq. (2).
        """
        node, end = self.values(w) if values is None else values
        n, rule, dtype = self.problem.n, self.rule, self.dtype
        A, B = jnp.asarray(rule.A, dtype), jnp.asarray(rule.B, dtype)
        # sum_j D_ij x_j - f(x_i, u_i) on [-1, 1]: review, eq. (21).
        defect = jnp.einsum("rp,spn->srn", A, self.support(w))
        defect = defect - jnp.einsum("rk,skn->srn", B, node[:, :, :n])
        residual = Equations(defect, node[:, :, n + 1 :] - w.path, end[1:] - w.end)
        # J^N = E + sum_i w_i F_i, the integral by quadrature: review, eqs (2), (15) and (21).
        rough = jnp.sum(w.u * self.roughness(w.u)) / 2
        return jnp.sum(node[:, :, n]) + end[0] + rough, residual

    @jax.jit
    def derivatives(self, w: Primal) -> tuple[Nodes, Ends]:
        """Values and Jacobians, node by node and of the endpoint functions."""
        both = lambda f: lambda *a: (f(*a), f(*a))
        node = jax.jacfwd(both(self.node), argnums=2, has_aux=True)
        over = jax.vmap(jax.vmap(node), in_axes=(None, None, 0))
        jacobian, value = over(*self._nodes_and_weights, self.inputs(w))
        end_jacobian, end_value = jax.jacfwd(both(self.end), has_aux=True)(self.end_inputs(w))
        return Nodes(value, jacobian), Ends(end_value, end_jacobian)

    def node_weights(self, y: Equations) -> Float[Array, "segment node out"]:
        """The factor of each entry of `Nodes.value` in the Lagrangian f + y^T c: -B^T y of the
        dynamics, 1 of the cost, y of the path constraints."""
        B = jnp.asarray(self.rule.B, y.defect.dtype)
        f = -jnp.einsum("rk,srn->skn", B, y.defect)
        return jnp.concatenate([f, jnp.ones_like(f[:, :, :1]), y.path], axis=2)

    def hessians(
        self, w: Primal, y: Equations
    ) -> tuple[Float[Array, "segment node in in"], Float[Array, "end end"]]:
        """Second derivatives of the Lagrangian f + y^T c: with respect to `inputs`, node by node,
        and, of its endpoint part, with respect to `end_inputs`."""
        weights = self.node_weights(y)
        node = lambda tau, w, q, c: jnp.dot(c, self.node(tau, w, q))
        over = jax.vmap(jax.vmap(hessian(node, 2)), in_axes=(None, None, 0, 0))
        at_nodes = over(*self._nodes_and_weights, self.inputs(w), weights)
        c = jnp.concatenate([jnp.ones_like(y.end, shape=1), y.end])
        return at_nodes, hessian(lambda b: jnp.dot(c, self.end(b)), 0)(self.end_inputs(w))


def hessian(f: Any, argnum: int) -> Any:
    """Second derivative of the scalar `f` by one argument, forward over reverse, symmetric to the
    last bit."""
    full = jax.jacfwd(jax.grad(f, argnums=argnum), argnums=argnum)

    def symmetric(*args: Any) -> Array:
        h = full(*args)
        return (h + h.T) / 2

    return symmetric


def clock_order(problem: Problem, clocks: int) -> Float[np.ndarray, "row clock"]:
    """The matrix from the times to their successive differences, which must stay above zero. It has
    no rows unless knots or both ends are free: one free end is kept in order by its bounds."""
    sequence = np.eye(clocks)[[0, *range(2, clocks), 1]]
    free = is_free(problem.initial_time) and is_free(problem.final_time)
    return np.diff(sequence, axis=0) if clocks > 2 or free else np.zeros((0, clocks))


def node_times(program: Transcription, w: Primal, at: np.ndarray) -> Float[Array, "segment k"]:
    """Times, in user units, of the points `at` (in tau) of every segment; review, eq. (5)."""
    tau = jnp.asarray(at, program.dtype)
    ends = program.clocks @ w.times * program.scale.t
    return (ends[:, :1] * (1 - tau)[None] + ends[:, 1:] * (1 + tau)[None]) / 2
