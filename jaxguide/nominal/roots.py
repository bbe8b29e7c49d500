"""Roots to rounding, differentiated as roots: Optimistix's Newton with elimination by hand."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.flatten_util
import jax.numpy as jnp
import optimistix as optx

from jaxguide.linalg import SmallLU

Unknown = TypeVar("Unknown")


def implicit_root(
    residual: Callable[[Any, Any], Any],
    z: Unknown,
    args: Any,
    tolerance: float,
    max_steps: int,
    size: Unknown | None = None,
) -> Unknown:
    """z with residual(z, args) = 0, by Newton from a nearby `z`.

    Derivatives by `args` are implicit, forward and reverse. Where Newton meets a singular Jacobian
    the answer is `z` itself, so that a failure shows by how much the conditions are missed.

    **Arguments:** `tolerance`: of the last step, relative to the unknowns and to `size`, how large
    each unknown is (default: one).
    """
    ones = jax.tree_util.tree_map(jnp.ones_like, z)
    unit = jax.lax.stop_gradient(ones if size is None else size)
    times = lambda a, b: jax.tree_util.tree_map(jnp.multiply, a, b)
    root = optx.root_find(
        lambda y, args: residual(times(y, unit), args),
        optx.Newton(rtol=tolerance, atol=tolerance, linear_solver=SmallLU()),
        jax.tree_util.tree_map(jnp.divide, z, unit),
        args,
        max_steps=max_steps,
        adjoint=optx.ImplicitAdjoint(linear_solver=SmallLU()),
        throw=False,
    ).value
    ok = jnp.all(jnp.isfinite(jax.flatten_util.ravel_pytree(root)[0]))
    return jax.tree_util.tree_map(lambda new, old: jnp.where(ok, new, old), times(root, unit), z)
