"""Relaxed dynamics: what a low grid may miss them by (review, problem B^N and Theorem 2)."""

from typing import Any

from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.problem import Problem
from jaxguide.transforms.integrals import WithIntegrals, joined_bounds, with_integrals
from jaxguide.transforms.wrapped import Wrapped, own_fields


def rewrapped(whole: Problem, problem: Problem) -> Problem:
    """`whole` around `problem` itself, whose derivatives count."""
    if type(whole) not in (WithIntegrals, Relaxed):
        return problem
    assert isinstance(whole, Wrapped)
    inner = rewrapped(whole.inner, problem)
    if isinstance(whole, WithIntegrals):
        return with_integrals(inner)
    return relaxed(inner, whole.control_bounds[1][inner.m :])


class Relaxed(Wrapped):
    """`inner` whose dynamics may be missed by its last n controls: the consistency relaxation
    |dx/dt - f| <= delta at the nodes. Review, problem B^N and Theorem 2."""

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.dynamics(t, x, u[: self.inner.m]) + u[self.inner.m :]

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.running_cost(t, x, u[: self.inner.m])

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.path_constraints(t, x, u[: self.inner.m])

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.integrands(t, x, u[: self.inner.m])


def relaxed(problem: Problem, delta: Float[Array, " n"]) -> Problem:
    """`problem` with its dynamics met to within `delta`, in units of state per time."""
    own = bounds_of(problem.control_bounds, problem.m, delta.dtype)
    return Relaxed(
        inner=problem,
        **own_fields(
            problem,
            control_names=problem.control_names + tuple(f"slack {s}" for s in problem.state_names),
            control_bounds=joined_bounds(own, (-delta, delta)),
        ),
    )
