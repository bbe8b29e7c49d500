"""A Problem on an infinite horizon mapped to a finite one, and its extremals mapped back."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaxguide.arrays import Array
from jaxguide.problem import Chosen, Path, Problem, endpoint_count
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.transforms.wrapped import Wrapped, own_fields


class Endless(Wrapped):
    """`inner`, whose horizon is infinite, in s of [-1, 1): t = t0 + scale (1 + s)/(1 - s).

    `scale`: the time from t0 to s = 0. `at_rest`: the state must vanish at the end, as `inner` says
    nothing of it. `even`: dt/ds is that of the start at all s.

    **Source:** review, section 3 on infinite horizons, with the bilinear map.
    """

    scale: Float[Array, ""]
    start: Float[Array, ""]
    at_rest: bool = eqx.field(static=True)
    even: bool = eqx.field(static=True, default=False)

    def clock(self, s: Any) -> tuple[Any, Any]:
        """t and dt/ds; at s = 1, where t is infinite and the state rests, dt/ds counts as 0."""
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


def made_finite(problem: Problem, guess: Any, scale: Any) -> tuple[Problem, Any]:
    """A problem whose final time is infinite, on [-1, 1], and a guess as an extremal of that."""
    opened_before = isinstance(guess, Extremal) and guess.stretch is not None
    return endless(problem, scale), closed(guess) if opened_before else guess


def endless(problem: Problem, scale: Any) -> Problem:
    """`problem`, whose final time is infinite, in s of [-1, 1]; `scale` in units of its time."""
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
    """`problem` with dt/ds of every `Endless` constant, as at its start: for sizes of quantities,
    which dt/ds would otherwise make infinite towards the end."""
    if not isinstance(problem, Wrapped):
        return problem
    changed: dict[str, Any] = {"even": True} if isinstance(problem, Endless) else {}
    return dataclasses.replace(problem, inner=evened(problem.inner), **changed)


def opened(extremal: Extremal) -> Extremal:
    """An extremal of an `Endless` problem in the user's time, its last node at t = inf; of any
    other, as it is."""
    problem = extremal.problem
    if not isinstance(problem, Endless):
        return extremal
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
    """The inverse of `opened`: an extremal with its last node at t = inf, in s of [-1, 1]."""
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
