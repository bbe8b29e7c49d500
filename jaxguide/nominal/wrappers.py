"""Problems made from another: with its integrals as states, with relaxed dynamics, on an endless
horizon brought to a finite one. Each adds states or controls after those of the problem inside."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.problem import (
    Chosen,
    Path,
    Problem,
    bounds_of,
    count,
    endpoint_count,
    initial_entries,
)
from jaxguide.trajectory import Extremal, Multipliers


class Wrapped(Problem):
    """`inner` as it is, but for what a subclass changes."""

    inner: Problem

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


FIELDS = (
    "state_names", "control_names", "initial_time", "final_time", "initial_state", "state_bounds",
    "control_bounds", "endpoint_bounds", "path_bounds", "integral_bounds",
)  # fmt: skip


def own_fields(problem: Problem, **changed: Any) -> dict[str, Any]:
    """The fields of a Problem around `problem`: its own, but for those `changed`."""
    return {name: getattr(problem, name) for name in FIELDS} | changed


def _joined(a: tuple, b: tuple) -> tuple[Array, Array]:
    return jnp.concatenate([a[0], b[0]]), jnp.concatenate([a[1], b[1]])


def rewrapped(whole: Problem, problem: Problem) -> Problem:
    """`whole` around `problem` itself, whose derivatives count."""
    if type(whole) not in (WithIntegrals, Relaxed):
        return problem
    assert isinstance(whole, Wrapped)
    inner = rewrapped(whole.inner, problem)
    if isinstance(whole, WithIntegrals):
        return with_integrals(inner)
    return relaxed(inner, whole.control_bounds[1][inner.m :])


class WithIntegrals(Wrapped):
    """`inner` with each of its integrals as a state that starts at zero and ends within bounds."""

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
    """`problem`, or a WithIntegrals of it where it has integral constraints."""
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
            state_bounds=_joined(states, bounds_of((-math.inf, math.inf), r, dtype)),
            endpoint_bounds=_joined(ends, bounds_of(problem.integral_bounds, r, dtype)),
        ),
    )


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
            control_bounds=_joined(own, (-delta, delta)),
        ),
    )


class Endless(Wrapped):
    """`inner`, whose horizon has no end, in s of [-1, 1): t = t0 + scale (1 + s)/(1 - s).

    **Source:** review, section 3 on infinite horizons, with the bilinear map.
    """

    scale: Float[Array, ""]
    start: Float[Array, ""]
    at_rest: bool = eqx.field(static=True)
    even: bool = eqx.field(static=True, default=False)  # rates as at the start, all along

    def clock(self, s: Any) -> tuple[Any, Any]:
        """t and dt/ds; at s = 1, where nothing moves any more, a rate of zero."""
        left = jnp.where(s < 1, 1 - s, 1.0)
        rate = jnp.where(s < 1, 2 * self.scale / left**2, 0.0)
        rate = jnp.full_like(rate, self.scale / 2) if self.even else rate
        return self.start + self.scale * (1 + s) / left, rate

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        t, rate = self.clock(t)
        return rate * self.inner.dynamics(t, x, u)

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        t, rate = self.clock(t)
        return rate * self.inner.running_cost(t, x, u)

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return self.inner.path_constraints(self.clock(t)[0], x, u)

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        t, rate = self.clock(t)
        return rate * self.inner.integrands(t, x, u)

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return self.inner.endpoint_cost(x0, xf, self.start, jnp.inf)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        """The weight W = 1 - s of the interpolant makes the state vanish at the end."""
        own = self.inner.endpoint_constraints(x0, xf, self.start, jnp.inf)
        return xf if self.at_rest else own


def endless(problem: Problem, scale: Any) -> Problem:
    """`problem`, whose final time is infinite, on [-1, 1]."""
    dtype = jnp.result_type(float)
    at_rest = endpoint_count(problem) == 0
    zero = jnp.zeros(problem.n, dtype)
    return Endless(
        inner=problem,
        scale=jnp.asarray(scale, dtype),
        start=jnp.asarray(problem.initial_time, dtype),
        at_rest=at_rest,
        **own_fields(
            problem,
            initial_time=jnp.asarray(-1.0, dtype),
            final_time=jnp.asarray(1.0, dtype),
            endpoint_bounds=(zero, zero) if at_rest else problem.endpoint_bounds,
        ),
    )


def evened(problem: Problem) -> Problem:
    """`problem`, an endless horizon's clock running evenly: of the size that counts, where near the
    end rates grow beyond all bounds."""
    if not isinstance(problem, Wrapped):
        return problem
    changed: dict[str, Any] = {"even": True} if isinstance(problem, Endless) else {}
    return dataclasses.replace(problem, inner=evened(problem.inner), **changed)


def opened(extremal: Extremal) -> Extremal:
    """An extremal of an `Endless` problem, in the user's time: its last node is at t = inf."""
    problem: Any = extremal.problem
    t = problem.clock(extremal.t)[0].at[-1].set(jnp.inf)
    rate = problem.clock(extremal.t)[1]
    rate = jnp.where(rate > 0, rate, jnp.inf)[:, None]
    m = extremal.multipliers
    nodal = (m.path / rate, m.state / rate, m.control / rate)
    nu = m.endpoint[:0] if problem.at_rest else m.endpoint
    out = dataclasses.replace(
        extremal,
        t=t,
        final_time=jnp.full_like(extremal.final_time, jnp.inf),
        multipliers=Multipliers(nu, *nodal, m.integral),
        problem=problem.inner,
        stretch=problem.scale,
        chosen=_rerooted(extremal.chosen, lambda path: path[1:]),
    )
    return out


def closed(extremal: Extremal) -> Extremal:
    """`opened` undone."""
    assert extremal.stretch is not None
    problem: Any = endless(extremal.problem, extremal.stretch)
    s = extremal.clock(extremal.t)
    rate = problem.clock(s)[1][:, None]
    m = extremal.multipliers
    nu = extremal.costate[-1] if problem.at_rest else m.endpoint
    return dataclasses.replace(
        extremal,
        t=s,
        final_time=jnp.ones_like(extremal.final_time),
        multipliers=Multipliers(nu, m.path * rate, m.state * rate, m.control * rate, m.integral),
        problem=problem,
        stretch=None,
        chosen=_rerooted(extremal.chosen, lambda path: ("inner", *path)),
    )


def _rerooted(chosen: Chosen | None, along: Callable[[Path], Path]) -> Chosen | None:
    return chosen and Chosen(tuple(map(along, chosen.paths)), chosen.bounds)
