"""A control as parameters, the values at its nodes and the final time, and the trajectory that they
give, from the start or from anywhere on the way. Linear between nodes, in normalised time.

**Source:** Libby's thesis, eqs (2.5)-(2.13).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.nominal.steps import dopri8
from jaxguide.problem import Problem, initial_values, is_free
from jaxguide.spectral import interval, nodes_lgl


class Departure(NamedTuple):
    """Where a trajectory begins: how far along the horizon, when, and in what state.

    `t` of None: at t0 + tau (tf - t0), and so moving with tf.
    """

    tau: Float[Array, ""]
    t: Float[Array, ""] | None
    x: Float[Array, " n"]


def pack(problem: Problem, controls: Float[Array, "k m"], tf: Any) -> Float[Array, " p"]:
    """a = (u_1, ..., u_k, tf), thesis, eq. (2.9); without tf where it is given."""
    flat = controls.reshape(-1)
    return jnp.append(flat, tf) if is_free(problem.final_time) else flat


def unpack(problem: Problem, a: Float[Array, " p"]) -> tuple[Float[Array, "k m"], Array]:
    """Node controls and final time."""
    if is_free(problem.final_time):
        return a[:-1].reshape(-1, problem.m), a[-1]
    return a.reshape(-1, problem.m), jnp.asarray(problem.final_time, a.dtype)


def control_at(
    positions: Float[Array, " k"], controls: Float[Array, "k m"], tau: Any
) -> Float[Array, " m"]:
    """The control at the scalar `tau`, thesis, eqs (4.30)-(4.31); beyond the ends, the line of the
    nearest interval."""
    i = interval(positions, tau)
    share = (tau - positions[i]) / (positions[i + 1] - positions[i])
    return controls[i] + share * (controls[i + 1] - controls[i])


def fly(
    problem: Problem,
    positions: Float[Array, " k"],
    a: Float[Array, " p"],
    start: Departure,
    degree: int,
) -> Float[Array, "interval node n_1"]:
    """State and running cost from `start` to the end, at the LGL points of every interval.

    Intervals that begin before `start` begin there instead, with their control: the parameter of
    the last node passed is then the control at `start`, and earlier ones do nothing.
    """
    controls, _ = unpack(problem, a)
    _, span, begin = _clock(problem, a, start)
    positions = jnp.maximum(positions, start.tau)
    points = jnp.asarray((nodes_lgl(degree + 1)[0] + 1) / 2, a.dtype)

    def across(y: Array, part: tuple) -> tuple[Array, Array]:
        tau, width, left, right = part

        def rate(s: Array, y: Array) -> Array:
            t, u = begin + span * (tau - start.tau + width * s), left + s * (right - left)
            x = y[:-1]
            rates = jnp.append(problem.dynamics(t, x, u), problem.running_cost(t, x, u))
            return width * span * rates  # thesis, eq. (2.7)

        ys = dopri8(rate, y, points)
        return ys[-1], ys

    parts = (positions[:-1], jnp.diff(positions), controls[:-1], controls[1:])
    y = jnp.append(start.x, jnp.zeros((), a.dtype))
    return jax.lax.scan(across, y, parts)[1]


def _clock(problem: Problem, a: Float[Array, " p"], start: Departure) -> tuple[Array, Array, Array]:
    """t0, the length of the whole horizon, and the time of `start`."""
    t0 = jnp.asarray(problem.initial_time, a.dtype)
    span = unpack(problem, a)[1] - t0
    return t0, span, t0 + start.tau * span if start.t is None else start.t


def outcome(
    problem: Problem,
    positions: Float[Array, " k"],
    a: Float[Array, " p"],
    start: Departure,
    degree: int,
) -> tuple[Float[Array, ""], Float[Array, " q"], Float[Array, " n"]]:
    """Cost and endpoint constraints (less their targets) from `start` on, and the state at the end:
    thesis, eqs (2.12)-(2.13)."""
    end = fly(problem, positions, a, start, degree)[-1, -1]
    t0, span, begin = _clock(problem, a, start)
    ends = (
        jnp.asarray(initial_values(problem, a.dtype)),
        end[:-1],
        t0,
        begin + (1 - start.tau) * span,
    )
    e = problem.endpoint_constraints(*ends)
    e = e - bounds_of(problem.endpoint_bounds, e.shape[0], e.dtype)[0]
    return problem.endpoint_cost(*ends) + end[-1], e, end[:-1]


def from_the_start(problem: Problem, dtype: Any) -> Departure:
    """At t0, in the initial state."""
    zero = jnp.zeros((), dtype)
    start = jnp.asarray(initial_values(problem, dtype))
    return Departure(zero, jnp.asarray(problem.initial_time, dtype), start)
