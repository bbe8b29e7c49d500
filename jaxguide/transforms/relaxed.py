"""Dynamics met to within a tolerance, without which a low grid may have no solution: review,
problem B^N and Theorem 2."""

from typing import Any

from jaxtyping import Float

from jaxguide.arrays import Array
from jaxguide.bounds import joined_bounds
from jaxguide.problem import Problem
from jaxguide.transforms.wrapped import Wrapped, own_fields, rewrapped


class Relaxed(Wrapped):
    """`inner` with n further controls, the slacks s of |s| <= delta: dx/dt = f + s.

    **Source:** review, problem B^N and Theorem 2: the relaxation |dx/dt - f| <= delta at the nodes.
    """

    def around(self, problem: Problem) -> Problem:
        inner = rewrapped(self.inner, problem)
        return relaxed(inner, self.control_bounds[1][inner.m :])

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.dynamics(t, x, u[: self.inner.m]) + u[self.inner.m :]

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.running_cost(t, x, u[: self.inner.m])

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.path_constraints(t, x, u[: self.inner.m])

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.integrands(t, x, u[: self.inner.m])


def relaxed(problem: Problem, delta: Float[Array, " n"]) -> Problem:
    """`problem` with its dynamics met to within `delta` (n,), in units of state per time."""
    own = own_fields(problem)
    own["control_names"] += tuple(f"slack {s}" for s in problem.state_names)
    slack = (-delta, delta)
    own["control_bounds"] = joined_bounds(own["control_bounds"], problem.m, slack, problem.n)
    return Relaxed(inner=problem, **own)
