"""Integral constraints as further states: an integral starts at zero and grows by its integrand."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxguide.bounds import joined_bounds
from jaxguide.problem import Problem, count, endpoint_count, initial_entries
from jaxguide.transforms.wrapped import Wrapped, own_fields, rewrapped


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
    r = count(problem, "integrands")
    if not r:
        return problem
    own = own_fields(problem)
    own["state_names"] += tuple(f"integral {i}" for i in range(r))
    own["initial_state"] = (*initial_entries(problem), *(np.zeros(()),) * r)
    any_number, q = (-math.inf, math.inf), endpoint_count(problem)
    own["state_bounds"] = joined_bounds(own["state_bounds"], problem.n, any_number, r)
    own["endpoint_bounds"] = joined_bounds(own["endpoint_bounds"], q, problem.integral_bounds, r)
    return WithIntegrals(inner=problem, **own)
