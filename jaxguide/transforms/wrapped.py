"""A Problem around another: the frame of every transformation of a Problem."""

import dataclasses
from typing import Any

from jaxguide.problem import Problem


class Wrapped(Problem):
    """The Problem `inner`, with the methods that a subclass writes in place of its own.

    Names and boundary data are fields of the frame itself: see `own_fields`.
    """

    inner: Problem

    def around(self, problem: Problem) -> Problem:
        """The same transformation of `problem`, in place of the user's Problem within.

        Here `problem` itself: a Wrapped that cannot be built again counts as the user's Problem.
        """
        return problem

    def parameter_paths(self) -> tuple[tuple[str | int, ...], ...]:
        return tuple(("inner", *path) for path in self.inner.parameter_paths())

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.dynamics(t, x, u)

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.running_cost(t, x, u)

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.path_constraints(t, x, u)

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.integrands(t, x, u)

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return self.inner.endpoint_cost(x0, xf, t0, tf)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return self.inner.endpoint_constraints(x0, xf, t0, tf)


BOUNDARY_DATA = (
    "state_names", "control_names", "initial_time", "final_time", "initial_state", "state_bounds",
    "control_bounds", "endpoint_bounds", "path_bounds", "integral_bounds",
)  # fmt: skip


def own_fields(problem: Problem, **changed: Any) -> dict[str, Any]:
    """The fields of a Problem around `problem`: its names and boundary data, and `changed` in
    place of those it names."""
    return {name: getattr(problem, name) for name in BOUNDARY_DATA} | changed


def rewrapped(whole: Problem, problem: Problem) -> Problem:
    """`problem` in the frames that stand around the user's Problem within `whole`."""
    return whole.around(problem) if isinstance(whole, Wrapped) else problem


def restated(problem: Problem, **changed: Any) -> Problem:
    """`problem` with other boundary data: `changed` replaces fields; where one of them is a
    property of `problem`, a `Wrapped` stands around it."""
    if changed.keys() <= {f.name for f in dataclasses.fields(problem)}:
        return dataclasses.replace(problem, **changed)
    return Wrapped(inner=problem, **own_fields(problem, **changed))
