"""Runge-Kutta steps: fixed ones of order four and eight, differentiable both ways and to any order,
and Diffrax's adaptive ones, of order eight.

Diffrax takes a quarter of a second to import, and most processes do without: it is imported where
it is used.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def dopri8(
    rate: Callable[[Any, Any], Any], y: Float[Array, " d"], times: Float[Array, " k"]
) -> Float[Array, "k d"]:
    """`y` at `times`, by one step of y' = rate(t, y) between each pair.

    The tableau is Diffrax's; its own `step` loops in a way that has no forward mode. A scan over
    the stages compiles the right-hand side once.
    """
    import diffrax

    tableau = diffrax.Dopri8.tableau
    stages = tableau.num_stages
    a = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower):
        a[i + 1, : i + 1] = row
    c = np.concatenate([[0.0], tableau.c])
    a, b, c = (jnp.asarray(v, y.dtype) for v in (a, tableau.b_sol, c))

    def step(y: Array, ends: tuple) -> tuple[Array, Array]:
        t, h = ends

        def stage(ks: Array, row: tuple) -> tuple[Array, None]:
            a_i, c_i, i = row
            k = rate(t + c_i * h, y + h * (a_i @ ks))
            return ks.at[i].set(k), None

        ks = jnp.zeros((stages, y.shape[0]), y.dtype)
        ks, _ = jax.lax.scan(stage, ks, (a, c, jnp.arange(stages)))
        y = y + h * (b @ ks)
        return y, y

    _, ys = jax.lax.scan(step, y, (times[:-1], jnp.diff(times)))
    return jnp.concatenate([y[None], ys])


def adaptive(
    rate: Callable[[Any, Any], Any],
    y: Float[Array, " d"],
    t0: Any,
    t1: Any,
    tolerance: float,
    max_steps: int,
    at: Array | None = None,
) -> Any:
    """Diffrax's solution of y' = rate(t, y) at `at`, or at `t1`, whose every step errs by
    `tolerance`, relative and absolute."""
    import diffrax

    saved = diffrax.SaveAt(t1=True) if at is None else diffrax.SaveAt(ts=at)
    return _diffeqsolve(rate, y, t0, t1, tolerance, max_steps, saveat=saved)


def adaptive_steps(
    rate: Callable[[Any, Any], Any],
    y: Float[Array, " d"],
    t0: Any,
    t1: Any,
    tolerance: float,
    max_steps: int,
) -> tuple[Float[Array, " step"], Float[Array, "step d"]]:
    """Times (inf beyond the last) and values of the steps of such a solution, which has no
    derivatives."""
    import diffrax

    steps, light = diffrax.SaveAt(steps=True), diffrax.ForwardMode()
    solution = _diffeqsolve(rate, y, t0, t1, tolerance, max_steps, saveat=steps, adjoint=light)
    return solution.ts, solution.ys


def _diffeqsolve(
    rate: Callable, y: Array, t0: Any, t1: Any, tolerance: float, max_steps: int, **options: Any
) -> Any:
    import diffrax

    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: rate(t, y)),
        diffrax.Dopri8(),
        t0,
        t1,
        None,
        y,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=max_steps,
        throw=False,
        **options,
    )


def rk4(rate: Any, y: Array, times: Float[Array, " k"]) -> Float[Array, "k d"]:
    """`y` at `times` by one classical Runge-Kutta step between each pair."""

    # A scan over the four stages: the rate is compiled once, not four times.
    a = jnp.asarray([0.0, 0.5, 0.5, 1.0], times.dtype)
    b = jnp.asarray([1 / 6, 1 / 3, 1 / 3, 1 / 6], times.dtype)

    def step(y: Array, interval: tuple) -> tuple[Array, Array]:
        t, h = interval

        def stage(carry: tuple, row: tuple) -> tuple[tuple, None]:
            k, total = carry
            a_i, b_i = row
            k = rate(t + a_i * h, y + a_i * h * k)
            return (k, total + b_i * k), None

        (_, total), _ = jax.lax.scan(stage, (jnp.zeros_like(y), jnp.zeros_like(y)), (a, b))
        y = y + h * total
        return y, y

    _, ys = jax.lax.scan(step, y, (times[:-1], jnp.diff(times)))
    return jnp.concatenate([y[None], ys])
