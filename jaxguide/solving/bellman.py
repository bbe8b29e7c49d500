"""`jg.bellman`: a coarse grid's solution, segment by segment as the principle of optimality has it.
Host only."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.linalg import power_of_two
from jaxguide.nominal.steps import adaptive
from jaxguide.problem import Problem
from jaxguide.solving.given import default_method
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal
from jaxguide.transforms.wrapped import restated
from jaxguide.types import RESULTS, usable


class Bellman(eqx.Module):
    """`extremals[k]` starts at `t[k]`, where the flight before it ended in `x[k]`; the last entries
    are the end of the flight. `objective`: of what was flown."""

    t: Float[Array, " edge"]
    x: Float[Array, "edge n"]
    extremals: tuple[Extremal, ...]
    objective: Float[Array, ""]
    result: RESULTS


def bellman(problem: Problem, method: Any = None, segments: int = 4, guess: Any = None) -> Bellman:
    """Solves, flies the first of `segments` equal parts of the horizon by the true dynamics, solves
    what remains from where that ended, and so on.

    A coarse grid's control, flown between its nodes, misses what the grid's own states say. Flown
    only over its first part, where what remains is solved anew from the flown state, the errors
    do not add up: each solution starts where the flight is, with all its nodes ahead.

    **Arguments:** `method`, `guess`: of the first solve, on a fixed mesh (`refinements=0`) to keep
    it coarse; each later solve starts from the last one.

    **Returns:** a `Bellman`. A solve that fails ends it: `.result` says why.

    **Source:** review, Remark 2, after Ross, Gong & Sekhavat, AIAA-2008-6448.
    """
    if segments < 1:
        raise ValueError(f"bellman: segments is {segments}; give at least 1.")
    method = default_method(problem) if method is None else method
    extremals: list[Extremal] = []
    times, states = [], []
    cost = jnp.zeros(())
    for k in range(segments):
        extremal = solve(problem, method, guess, throw=False)
        extremals.append(extremal)
        if not usable(extremal.result):
            break
        if not times:
            times, states = [extremal.t[0]], [extremal.x[0]]
        t0, tf = extremal.t[0], extremal.t[-1]
        t1 = t0 + (tf - t0) / (segments - k)
        x, spent = _flown(extremal, states[-1], t0, t1)
        cost = cost + spent
        times, states = [*times, t1], [*states, x]
        problem = restated(problem, initial_time=t1, initial_state=tuple(x))
        guess = _rest(extremal, t1)
    last = extremals[-1]
    ends = (states[0], states[-1], times[0], times[-1]) if times else None
    total = cost + last.problem.endpoint_cost(*ends) if ends else jnp.nan * cost
    return Bellman(
        jnp.stack(times) if times else jnp.zeros(0),
        jnp.stack(states) if states else jnp.zeros((0, problem.n)),
        tuple(extremals),
        total,
        last.result,
    )


@jax.jit
def _flown(extremal: Extremal, x: Array, t0: Array, t1: Array) -> tuple[Array, Array]:
    """State and cost at `t1`, flown with the extremal's control from `x` at `t0`, in units of their
    sizes along it."""
    problem, size = extremal.problem, extremal.sizes()
    unit = power_of_two(jnp.append(size.x, size.cost))

    def rate(t: Any, y: Array) -> Array:
        x, u = (y * unit)[:-1], extremal.point(t).u
        return jnp.append(problem.dynamics(t, x, u), problem.running_cost(t, x, u)) / unit

    solution = adaptive(rate, jnp.append(x, 0.0) / unit, t0, t1, 1e-11, 16384)
    y = solution.ys[-1] * unit
    return y[:-1], y[-1]


@jax.jit
def _rest(extremal: Extremal, t1: Array) -> Extremal:
    """What `extremal` says from `t1` on, on its own nodes, as the next guess."""
    share = (extremal.t - extremal.t[0]) / (extremal.t[-1] - extremal.t[0])
    t = t1 + (extremal.t[-1] - t1) * share
    at = jax.vmap(extremal.point)(t)
    step = extremal.degree
    before = lambda v: v[np.arange(step, len(t), step)]
    return dataclasses.replace(
        extremal, t=t, x=at.x, u=at.u, costate=at.costate,
        u_before=None if extremal.u_before is None else before(at.u),
        costate_before=None if extremal.costate_before is None else before(at.costate),
    )  # fmt: skip
