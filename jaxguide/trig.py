r"""Sine and cosine as branch-free polynomials, for rollouts that must vectorise.

`jnp.sin` on CPU is not vectorised in float64 (one library call a lane) and shares
nothing with `jnp.cos`. Here both come from one reduction $x = n\pi/2 + r$,
$|r| \le \pi/4$, and two short polynomials in $r^2$: multiplies, adds and selects only.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

# Largest |x| [rad] reduced; beyond it the answer is nan, never a wrong number.
X_MAX = 1e5

# pi as a sum (Cody & Waite). All parts but the last have so few bits (33, or 8 in
# float32) that n * part is exact for every n < 2**15 that X_MAX allows, halves too.
_PI = {
    "float64": (3.1415926534682512, 1.2154201012607932e-10, 4.044532497591901e-21),
    "float32": (
        3.140625,
        0.000965118408203125,
        2.5331974029541016e-06,
        1.984187159361081e-09,
    ),
}

# sin r = r + r^3 P(r^2), from the constant up: minimax for |r| <= pi/2 (Remez exchange
# in 60 digits), relative error 2e-19 (float64), 5e-9 (float32).
_SIN = {
    "float64": (
        -0.16666666666666666,
        0.008333333333333212,
        -0.00019841269841215284,
        2.755731921213166e-06,
        -2.5052106960141802e-08,
        1.6058943927412e-10,
        -7.643097346753864e-13,
        2.7222509636237346e-15,
    ),
    "float32": (
        -0.16666659712791443,
        0.008333087898790836,
        -0.00019811101083178073,
        2.608904196677031e-06,
    ),
}

# Adding 1.5 * 2**(mantissa bits) leaves an integer in the low bits of the float: a bit
# cast then reads its parity, where a conversion would also clamp and test for nan.
_MAGIC = {
    "float64": (1.5 * 2**52, jnp.int64, 63),
    "float32": (1.5 * 2**23, jnp.int32, 31),
}


def _round(x):
    return lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)


def _signed_sin(x, n, sign):
    """$\\pm\\sin(x - n\\pi)$, negative where the integer `sign` is odd."""
    kind = x.dtype.name
    r = x
    for part in _PI[kind]:
        r = r - n * part
    z = r * r
    p = _SIN[kind][-1]
    for c in _SIN[kind][-2::-1]:
        p = p * z + c
    s = r + (r * z) * p
    magic, integer, top = _MAGIC[kind]
    flip = lax.bitcast_convert_type(sign + magic, integer) << top
    return lax.bitcast_convert_type(
        lax.bitcast_convert_type(s, integer) ^ flip, x.dtype
    )


@jax.custom_jvp
def _sincos(x):
    # One select covers every failure: nan stays, inf and the unreducible become nan.
    x = jnp.where(jnp.abs(x) <= X_MAX, x, jnp.nan)
    m = _round(x * 0.3183098861837907)
    h = _round(x * 0.3183098861837907 - 0.5)
    return _signed_sin(x, m, m), _signed_sin(x, h + 0.5, h + 1)


@_sincos.defjvp
def _sincos_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    s, c = _sincos(x)
    return (s, c), (c * dx, -s * dx)


def sincos(x: ArrayLike) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    r"""Both $\sin x$ and $\cos x$ for little more than the price of one.

    **Arguments:** `x`: angle [rad], float32 or float64, any shape.

    **Returns:** `(sin x, cos x)`, of the shape and dtype of `x`; both nan where `x` is
    nan or infinite or `|x| > X_MAX` (1e5 rad). The sign of -0.0 is not kept.

    **Error:** absolute, over the whole range: 2e-16 in float64, 1e-7 in float32. Both
    are also small relative to the value itself, near the zeros too.

    **Raises:** `TypeError` unless `x` is float32 or float64.

    The derivative rule is $d\sin = \cos$, $d\cos = -\sin$ on the values already at
    hand, to any order, forward and reverse.

    **Source:** Cody & Waite, *Software Manual for the Elementary Functions* (1980),
    chapter 8, for the reduction; coefficients computed for this module.
    """
    x = jnp.asarray(x)
    if x.dtype.name not in _PI:
        raise TypeError(f"sincos needs float32 or float64, got {x.dtype.name}.")
    return _sincos(x)


def sin(x: ArrayLike) -> Float[Array, "..."]:
    r"""$\sin x$ as `sincos` computes it; the unused cosine is compiled away."""
    return sincos(x)[0]


def cos(x: ArrayLike) -> Float[Array, "..."]:
    r"""$\cos x$ as `sincos` computes it; the unused sine is compiled away."""
    return sincos(x)[1]
