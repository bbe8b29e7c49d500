"""Integral constraints as further states: an integral starts at zero and grows by its integrand."""

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.bounds import bounds_of
from jaxguide.problem import Problem, count, endpoint_count, initial_entries
from jaxguide.transforms.wrapped import Wrapped, own_fields, rewrapped


def joined_bounds(a: tuple, b: tuple) -> tuple[Array, Array]:
    """Bounds of the components of `a` and, after them, those of `b`."""
    return jnp.concatenate([a[0], b[0]]), jnp.concatenate([a[1], b[1]])


class WithIntegrals(Wrapped):
    """`inner` with each of its integrals as a state that starts at zero and ends within bounds."""

    def around(self, problem: Problem) -> Problem:
        return with_integrals(rewrapped(self.inner, problem))

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        x = x[: self.inner.n]
        return jnp.concatenate([self.inner.dynamics(t, x, u), self.inner.integrands(t, x, u)])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.running_cost(t, x[: self.inner.n], u)

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.path_constraints(t, x[: self.inner.n], u)

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.zeros((0,), x.dtype)

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return self.inner.endpoint_cost(x0[: self.inner.n], xf[: self.inner.n], t0, tf)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        n = self.inner.n
        own = self.inner.endpoint_constraints(x0[:n], xf[:n], t0, tf)
        return jnp.concatenate([own, xf[n:]])


def with_integrals(problem: Problem) -> Problem:
    """`problem` with its integral constraints as states; `problem` itself if it has none."""
    dtype, r = jnp.result_type(float), count(problem, "integrands")
    if not r:
        return problem
    ends = bounds_of(problem.endpoint_bounds, endpoint_count(problem), dtype)
    states = bounds_of(problem.state_bounds, problem.n, dtype)
    return WithIntegrals(
        inner=problem,
        **own_fields(
            problem,
            state_names=problem.state_names + tuple(f"integral {i}" for i in range(r)),
            initial_state=(*initial_entries(problem), *(jnp.zeros((), dtype),) * r),
            state_bounds=joined_bounds(states, bounds_of((-math.inf, math.inf), r, dtype)),
            endpoint_bounds=joined_bounds(ends, bounds_of(problem.integral_bounds, r, dtype)),
        ),
    )
