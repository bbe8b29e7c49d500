"""A Problem's functions at one point of a mesh, scaled, and the small programs that evaluate them
at many: of any mesh, for they know nothing of it.

**Source:** Ross & Karpenko, review (2012): problem P, eq. (2).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array
from jaxguide.nominal.direct.unknowns import Scale
from jaxguide.problem import Problem, is_free, with_parameters


class PointFunctions(eqx.Module):
    """`problem` in the units of `scale`; `clocks`: how many times there are: t0, tf, free knots."""

    problem: Problem
    scale: Scale
    clocks: int = eqx.field(static=True)

    @property
    def order(self) -> Float[np.ndarray, "row clock"]:
        """Rows that must stay positive on the times: see `clock_order`."""
        return clock_order(self.problem, self.clocks)

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
        clock = self.clocks
        x0, times, p, xf = b[:n], b[n : n + clock], b[n + clock : -n], b[-n:]
        problem = with_parameters(self.problem, p * scale.p)
        at = (x0 * scale.x, xf * scale.x, times[0] * scale.t, times[1] * scale.t)
        cost = problem.endpoint_cost(*at) / scale.objective
        e = problem.endpoint_constraints(*at) / scale.end[: scale.end.shape[0] - len(self.order)]
        return jnp.concatenate([cost[None], e, self.order @ times])


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


def clock_order(problem: Problem, clocks: int) -> Float[np.ndarray, "row clock"]:
    """The matrix from the times to their successive differences, which must stay above zero. It has
    no rows unless knots or both ends are free: one free end is kept in order by its bounds."""
    sequence = np.eye(clocks)[[0, *range(2, clocks), 1]]
    free = is_free(problem.initial_time) and is_free(problem.final_time)
    return np.diff(sequence, axis=0) if clocks > 2 or free else np.zeros((0, clocks))
