"""Small dense programs, min f(a) subject to c(a) = 0: Newton on the KKT system, with safeguards,
in fixed shapes and without LAPACK; derivatives by the implicit function theorem."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.linalg import cholesky_positive, gauss_solve
from jaxguide.nominal.roots import implicit_root

Values = Callable[[Array, Any], tuple[Array, Array]]  # (a, args) -> f, c

# Of the search, chosen, not tuned; `polished` finds the last digits whatever they are. Step lengths
# tried at once; scaled step below which a full Newton step is taken unasked; KKT residual at which
# the search ends.
_STEPS, _NEAR, _SEARCH = tuple(0.5**k for k in range(12)), 1e-2, 1e-9
# Shifts of the Hessian, relative to its largest entry: the first, the factor to the next, and the
# largest. Chosen, not tuned.
_SHIFT, _GROW, _SHIFT_MAX = 1e-4, 10, 1e8
# Last relative step and residual of the root finder, rounding; and the most steps it may take, far
# more than Newton's method does from `_SEARCH`.
_ROOT, _ROOT_STEPS = 1e-13, 12


class KKTPoint(NamedTuple):
    """A point and its multipliers: grad f + nu^T grad c = 0, c = 0."""

    a: Float[Array, " p"]
    nu: Float[Array, " q"]


class Derivatives(NamedTuple):
    """f, c, their first derivatives, the least-squares multipliers, and the Hessian of f + nu c."""

    f: Float[Array, ""]
    c: Float[Array, " q"]
    gradient: Float[Array, " p"]
    jacobian: Float[Array, "q p"]
    nu: Float[Array, " q"]
    hessian: Float[Array, "p p"]


def conditions(values: Values, z: KKTPoint, args: Any) -> KKTPoint:
    """The gradient of the Lagrangian, and c: both vanish at a solution."""

    def lagrangian(a: Array) -> tuple[Array, Array]:
        f, c = values(a, args)
        return f + jnp.dot(z.nu, c), c

    gradient, c = jax.grad(lagrangian, has_aux=True)(z.a)
    return KKTPoint(gradient, c)


def residual(values: Values, z: KKTPoint, args: Any) -> Float[Array, ""]:
    """The largest entry of `conditions`."""
    return jnp.max(jnp.abs(jnp.concatenate(conditions(values, z, args))))


def derivatives(values: Values, a: Array, args: Any) -> Derivatives:
    """Exact, by autodiff: forward over reverse."""
    jacobian, (f, c) = jax.jacrev(lambda a: _twice(values(a, args)), has_aux=True)(a)
    gradient, jacobian = jacobian
    nu = gauss_solve(jacobian @ jacobian.T, -jacobian @ gradient)

    def slope(a: Array) -> Array:
        return conditions(values, KKTPoint(a, nu), args).a

    return Derivatives(f, c, gradient, jacobian, nu, jax.jacfwd(slope)(a))


def _twice(out: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    return out, out


class _Tangent(NamedTuple):
    """The plane tangent to the constraints: normal step to c = 0, projector, reduced Hessian."""

    normal: Float[Array, " p"]
    projector: Float[Array, "p p"]
    matrix: Float[Array, "p p"]  # the Hessian along the plane, a positive multiple of I across it
    size: Float[Array, ""]


def _tangent(d: Derivatives) -> _Tangent:
    gram = d.jacobian @ d.jacobian.T
    eye = jnp.eye(d.gradient.shape[0], dtype=d.gradient.dtype)
    projector = eye - d.jacobian.T @ gauss_solve(gram, d.jacobian)
    size = jnp.max(jnp.abs(d.hessian)) + jnp.finfo(d.f.dtype).tiny
    matrix = projector @ d.hessian @ projector + size * (eye - projector)
    return _Tangent(-d.jacobian.T @ gauss_solve(gram, d.c), projector, matrix, size)


def local_minimum(
    values: Values, a: Array, args: Any, iterations: int
) -> tuple[KKTPoint, Float[Array, ""], Bool[Array, ""]]:
    """A local minimum from `a`, its KKT residual, and whether the Hessian of the Lagrangian is
    positive along the constraints there (second-order sufficiency). Not for differentiation.

    Each step is normal to the constraints (to c = 0) plus along them (Newton, its matrix shifted
    until positive, so that no maximum or saddle attracts), no longer than one in any scaled
    unknown, cut by an l1 merit function. `values` should be scaled to gradients of order one.
    """

    def body(carry: tuple) -> tuple:
        a, _, _, _, k = carry
        d = derivatives(values, a, args)
        t = _tangent(d)
        shifted = lambda delta: t.matrix + delta * t.projector
        delta = jax.lax.while_loop(
            lambda s: ~cholesky_positive(shifted(s)) & (s < _SHIFT_MAX * t.size),
            lambda s: jnp.maximum(_GROW * s, _SHIFT * t.size),
            jnp.zeros_like(t.size),
        )
        along = t.projector @ (d.gradient + d.hessian @ t.normal)
        step = t.normal - t.projector @ gauss_solve(shifted(delta), along)
        length = jnp.max(jnp.abs(step))
        step = step / jnp.maximum(1.0, length)
        # The merit function is exact above |nu|; twice that and 1 leave room for nu to change.
        weight = 2 * jnp.max(jnp.abs(d.nu), initial=0.0) + 1.0
        merit = lambda f, c: f + weight * jnp.sum(jnp.abs(c))
        sizes = jnp.asarray(_STEPS, a.dtype)
        at = jax.vmap(lambda s: merit(*values(a + s * step, args)))(sizes)
        at = jnp.where(jnp.isfinite(at), at, jnp.inf)
        falls = at < merit(d.f, d.c)
        best = jnp.where(jnp.any(falls), jnp.argmax(falls), jnp.argmin(at))
        # Near the solution the merit function may refuse good steps (Maratos).
        best = jnp.where((length < _NEAR) & (delta == 0), 0, best)
        off = jnp.max(jnp.abs(d.gradient + d.nu @ d.jacobian))
        error = jnp.maximum(off, jnp.max(jnp.abs(d.c), initial=0.0))
        error = jnp.where(jnp.isfinite(error), error, jnp.inf)
        done = error <= _SEARCH
        a = jnp.where(done | jnp.isinf(error), a, a + sizes[best] * step)
        return a, KKTPoint(a, d.nu), error, delta == 0, k + 1

    going = lambda c: (c[2] > _SEARCH) & jnp.isfinite(c[2]) & (c[4] < iterations)
    q = jax.eval_shape(values, a, args)[1].shape[0]
    start = KKTPoint(a, jnp.zeros(q, a.dtype))
    far, never = jnp.asarray(1e300, a.dtype), jnp.array(False)
    carry = (a, start, far, never, jnp.zeros((), jnp.int32))
    _, z, error, minimal, _ = jax.lax.while_loop(going, body, carry)
    return z, error, minimal


def polished(values: Values, z: KKTPoint, args: Any) -> KKTPoint:
    """`z` by Newton to rounding; differentiable in `args`, implicitly, forward and reverse."""
    missed = lambda z, args: conditions(values, z, args)
    return implicit_root(missed, z, args, _ROOT, _ROOT_STEPS, within=_ROOT)
