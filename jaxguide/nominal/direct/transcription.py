"""Problem P on a mesh, as a nonlinear program with a structure.

Every function here is evaluated node by node; nothing assembles a matrix of the whole.

**Source:** Ross & Karpenko, review (2012): problem P, eq. (2), as problem B^N, eq. (21).
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, put, traced_once, xp
from jaxguide.nominal.direct.collocation import Collocation, collocation
from jaxguide.nominal.direct.unknowns import Arcwise, Counts, Equations, Primal
from jaxguide.problem import Problem, is_free
from jaxguide.problem.points import (
    PointFunctions,
    Scale,
    at_points,
    point_derivatives,
    point_functions,
    point_hessians,
    point_values,
    unit_scale,
)
from jaxguide.spectral import NodeFamily
from jaxguide.spectral.grids import legendre


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


_LEAVES, _STATIC = ("problem", "scale", "edges", "arcwise"), ("family", "points", "log")


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, eq=False)
class Transcription:
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
    family: str | NodeFamily  # name or family
    points: int
    arcwise: "Arcwise | None" = None
    log: bool = False

    # A plain class: its attributes are read ten thousand times in a solve on the host.

    def tree_flatten_with_keys(self) -> tuple[Any, Any]:
        """Leaves with their names, and what is static."""
        key = jax.tree_util.GetAttrKey
        leaves = [(key(name), getattr(self, name)) for name in _LEAVES]
        return leaves, tuple(getattr(self, name) for name in _STATIC)

    @classmethod
    def tree_unflatten(cls, static: Any, leaves: Any) -> "Transcription":
        """The inverse, for leaves of any kind."""
        out = object.__new__(cls)
        for name, value in zip((*_LEAVES, *_STATIC), (*leaves, *static), strict=True):
            object.__setattr__(out, name, value)
        return out

    @functools.cached_property
    def rule(self) -> Collocation:
        """Nodes, weights and defect matrices of one segment."""
        return collocation(self.family, self.points)

    @functools.cached_property
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

    @functools.cached_property
    def clocks(self) -> Float[Array, "segment two clock"]:
        """The linear map from the times to (t_a, t_b), the end times of every segment."""
        return xp.stack([self.edges[:-1], self.edges[1:]], axis=1)

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
        parts = zip(xp.split(vector, cuts), shapes, strict=True)
        return Primal(*(part.reshape(shape) for part, shape in parts))

    def starts(self, w: Primal) -> Float[Array, "segment n"]:
        """State at the start of every segment."""
        return xp.concatenate([w.x0[None], w.x[:-1, -1]])

    def support(self, w: Primal) -> Float[Array, "segment support n"]:
        """States at all support points of every segment."""
        return xp.concatenate([self.starts(w)[:, None], w.x], axis=1)

    def inputs(self, w: Primal) -> Float[Array, "segment node in"]:
        """(x, u, t_a, t_b, p) at every node."""
        rule, counts = self.rule, self.counts
        x = self.support(w)[:, rule.first : rule.first + self.points]
        at = xp.concatenate(
            [self.clocks @ w.times, xp.broadcast_to(w.p, (counts.segments, len(w.p)))], axis=1
        )
        at = xp.broadcast_to(at[:, None], (counts.segments, self.points, at.shape[1]))
        return xp.concatenate([x, w.u, at], axis=2)

    @functools.cached_property
    def functions(self) -> PointFunctions:
        """The Problem's functions at a point, scaled: they know nothing of the mesh."""
        own = self.counts.end - len(self.order)
        return point_functions(self.problem, self.scale._replace(end=self.scale.end[:own]))

    def end_inputs(self, w: Primal) -> Float[Array, " in"]:
        """(x0, times, p, xf)."""
        return xp.concatenate([w.x0, w.times, w.p, w.x[-1, -1]])

    def _points(self, w: Primal) -> tuple[tuple, tuple]:
        """Nodes, weights and inputs of every node, one after the other, and of the ends, which know
        the first two times alone."""
        rule, dtype, q = self.rule, self.dtype, self.inputs(w)
        each = lambda a: xp.asarray(xp.broadcast_to(a, q.shape[:2]).reshape(-1), dtype)
        ends = xp.concatenate([w.x0, w.times[:2], w.p, w.x[-1, -1]])
        return (each(rule.nodes), each(rule.w), q.reshape(-1, q.shape[2])), (ends,)

    def _by_segment(self, a: Array) -> Array:
        return a.reshape(-1, self.points, *a.shape[1:])

    @functools.cached_property
    def _own_ends(self) -> np.ndarray:
        """Which of `end_inputs` are no free knot."""
        counts = self.counts
        kept = np.ones(2 * counts.n + counts.times + counts.parameters, bool)
        kept[counts.n + 2 : counts.n + counts.times] = False
        return np.flatnonzero(kept)

    @traced_once  # like those below
    def values(self, w: Primal) -> tuple[Float[Array, "segment node out"], Float[Array, " end"]]:
        """`PointFunctions.node` at every node; E, e, and the times' differences."""
        node, end = at_points(point_values, self.functions, *self._points(w))
        return self._by_segment(node), xp.concatenate([end, self.order @ w.times])

    def roughness(self, u: Float[Array, "segment node m *k"]) -> Float[Array, "segment node m *k"]:
        """Gradient, linear in u, of half the weighted squares of each control's upper Legendre
        coefficients. That term keeps a control smooth on a singular arc, where nothing else
        does."""
        if self.arcwise is None:
            return xp.zeros_like(u)
        return xp.einsum("sm,ij,sjm...->sim...", self.arcwise.smooth, self._upper_squares, u)

    @functools.cached_property
    def _upper_squares(self) -> Float[np.ndarray, "node node"]:
        """The sum of squares of the upper half of the Legendre coefficients, of values at nodes."""
        upper = legendre(self.rule.nodes)[self.points // 2 :]
        return upper.T @ upper

    @traced_once
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
        A, B = xp.asarray(rule.A, dtype), xp.asarray(rule.B, dtype)
        # sum_j D_ij x_j - f(x_i, u_i) on [-1, 1]: review, eq. (21).
        defect = A @ self.support(w) - B @ node[:, :, :n]
        residual = Equations(defect, node[:, :, n + 1 :] - w.path, end[1:] - w.end)
        # J^N = E + sum_i w_i F_i, the integral by quadrature: review, eqs (2), (15) and (21).
        rough = xp.sum(w.u * self.roughness(w.u)) / 2
        return xp.sum(node[:, :, n]) + end[0] + rough, residual

    @traced_once
    def derivatives(self, w: Primal) -> tuple[Nodes, Ends]:
        """Values and Jacobians, node by node and of the endpoint functions."""
        node, end = at_points(point_derivatives, self.functions, *self._points(w))
        (n, rows), p = (self.counts.n, self.order), self.counts.parameters
        jacobian = end[1]
        if self.counts.times > 2:
            wide = xp.zeros_like(jacobian, shape=(len(jacobian), 2 * n + self.counts.times + p))
            jacobian = put(wide, np.s_[:, self._own_ends], jacobian)
        order = xp.asarray(np.pad(rows, ((0, 0), (n, n + p))), self.dtype)
        value = xp.concatenate([end[0], rows @ w.times])
        ends = Ends(value, xp.concatenate([jacobian, order]))
        return Nodes(*map(self._by_segment, node)), ends

    def node_weights(self, y: Equations) -> Float[Array, "segment node out"]:
        """The factor of each entry of `Nodes.value` in the Lagrangian f + y^T c: -B^T y of the
        dynamics, 1 of the cost, y of the path constraints."""
        B = xp.asarray(self.rule.B, y.defect.dtype)
        f = -(B.T @ y.defect)
        return xp.concatenate([f, xp.ones_like(f[:, :, :1]), y.path], axis=2)

    def hessians(
        self, w: Primal, y: Equations
    ) -> tuple[Float[Array, "segment node in in"], Float[Array, "end end"]]:
        """Second derivatives of the Lagrangian f + y^T c: with respect to `inputs`, node by node,
        and, of its endpoint part, with respect to `end_inputs`."""
        points, ends = self._points(w)
        factors = self.node_weights(y)
        factors = factors.reshape(-1, factors.shape[2])
        own = y.end[: len(self.functions.scale.end)]
        c = xp.concatenate([xp.ones_like(y.end, shape=1), own])
        node, end = at_points(point_hessians, self.functions, (*points, factors), (*ends, c))
        if self.counts.times > 2:
            size = 2 * self.counts.n + self.counts.times + self.counts.parameters
            wide = xp.zeros_like(end, shape=(size, size))
            end = put(wide, np.ix_(self._own_ends, self._own_ends), end)
        return self._by_segment(node), end


def node_times(program: Transcription, w: Primal, at: np.ndarray) -> Float[Array, "segment k"]:
    """Times, in user units, of the points `at` (in tau) of every segment; review, eq. (5)."""
    tau = xp.asarray(at, program.dtype)
    ends = program.clocks @ w.times * program.scale.t
    return (ends[:, :1] * (1 - tau)[None] + ends[:, 1:] * (1 + tau)[None]) / 2


def clock_order(problem: Problem, clocks: int) -> Float[np.ndarray, "row clock"]:
    """The matrix from the times to their successive differences, which must stay above zero. It has
    no rows unless knots or both ends are free: one free end is kept in order by its bounds."""
    sequence = np.eye(clocks)[[0, *range(2, clocks), 1]]
    free = is_free(problem.initial_time) and is_free(problem.final_time)
    return np.diff(sequence, axis=0) if clocks > 2 or free else np.zeros((0, clocks))


def blank_scale(problem: Problem, knots: int) -> Scale:
    """User units as they are, of a `problem` with so many free `knots`."""
    own = unit_scale(problem)
    more = xp.ones(len(clock_order(problem, 2 + knots)), own.end.dtype)
    return own._replace(end=xp.concatenate([own.end, more]))
