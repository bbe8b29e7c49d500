"""Roots to rounding, differentiated as roots, in fixed shapes and without LAPACK."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.linalg import gauss_solve

Unknown = TypeVar("Unknown")


def implicit_root(
    residual: Callable[[Any, Any], Any],
    z: Unknown,
    args: Any,
    tolerance: float,
    max_steps: int,
    size: Unknown | None = None,
    within: float = jnp.inf,
) -> Unknown:
    """z with residual(z, args) = 0, by Newton from a nearby `z`.

    Derivatives by `args` are implicit, forward and reverse, to any order; whether there is a root
    is the caller's to say (`differentiable_if`). Where Newton meets a singular Jacobian the answer
    is `z` itself, so that a failure shows by how much the conditions are missed.

    **Arguments:** `tolerance`: of the error that the last step leaves, relative to `size`, the
    unit of each unknown (default: one), and to the unknown in it. `within`: of the residual before
    the last step, if it is scaled.

    Optimistix's Newton raises inside its derivative where the residual is NaN; in a batch a failure
    must be a value.
    """
    flat, unravel = jax.flatten_util.ravel_pytree(z)
    ones = jnp.ones_like(flat)
    unit = ones if size is None else jax.lax.stop_gradient(jax.flatten_util.ravel_pytree(size)[0])

    def missed(v: Array) -> Array:
        return jax.flatten_util.ravel_pytree(residual(unravel(v * unit), args))[0]

    def search(_: Any, v: Array) -> Array:
        root = _newton(missed, v, tolerance, max_steps, within)
        return jnp.where(jnp.all(jnp.isfinite(root)), root, v)

    def tangent_solve(g: Any, y: Array) -> Array:
        return gauss_solve(jax.jacfwd(g)(jnp.zeros_like(y)), y)

    root = jax.lax.custom_root(missed, jax.lax.stop_gradient(flat / unit), search, tangent_solve)
    return unravel(root * unit)


def _newton(
    missed: Callable[[Array], Array],
    v: Float[Array, " k"],
    tolerance: float,
    max_steps: int,
    within: float,
) -> Float[Array, " k"]:
    """Newton until what is left, if the steps go on shrinking as the last two did, is below
    `tolerance` of 1 + |v|, and the last residual was below `within`. A NaN ends it."""

    def body(carry: tuple) -> tuple:
        v, last, _, _, k = carry
        jacobian, r = jax.jacfwd(lambda v: _twice(missed(v)), has_aux=True)(v)
        step = gauss_solve(jacobian, r)
        v = v - step
        return v, jnp.max(jnp.abs(step) / (1 + jnp.abs(v))), last, jnp.max(jnp.abs(r)), k + 1

    def going(carry: tuple) -> Array:
        _, last, before, r, k = carry
        left = (last * last > tolerance * before) | (r > within)  # false of NaN
        return (k == 0) | (left & (k < max_steps))

    # Before the first step there is none: one step alone says nothing unless it is zero.
    none = jnp.zeros((), v.dtype)
    start = (v, none, none, none, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(going, body, start)[0]


def _twice(out: Array) -> tuple[Array, Array]:
    return out, out


def differentiable_if(good: Bool[Array, ""], tree: Unknown, of: Any) -> Unknown:
    """`tree`, a function of `of`, with derivatives that are NaN unless `good`: where no root was
    found the implicit derivative is a number that means nothing."""
    numbers, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(_guarded(numbers, good, eqx.filter(of, eqx.is_inexact_array)), others)


@jax.custom_jvp
def _guarded(tree: Any, good: Bool[Array, ""], of: Any) -> Any:
    del good, of
    return tree


@_guarded.defjvp
def _guarded_jvp(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    (tree, good, _), (moved, _, cause) = primals, tangents
    # By its cause too: a NaN parameter that only comparisons look at reaches no part of `tree`.
    causes = jnp.asarray(sum(jnp.sum(t) for t in jax.tree_util.tree_leaves(cause)))
    lost = jnp.where(good, 0.0, causes) * jnp.where(good, 0.0, jnp.nan)
    times = lambda t: t * jnp.where(good, 1.0, jnp.nan).astype(t.dtype) + lost.astype(t.dtype)
    return tree, jax.tree_util.tree_map(times, moved)
