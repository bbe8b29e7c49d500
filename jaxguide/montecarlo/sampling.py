"""Where on the unit cube the cases of a sweep lie: at random, stratified, or evenly spread.

A point is a pure function of its case's number and of a key, so that a case can be flown alone, in
any order and in any process; no table with a row for each case is stored.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

SAMPLINGS = ("random", "latin_hypercube", "sobol")
_BITS = 32  # of a Sobol number and of a uint32 layer
# Rounds that mix the layers of a Latin hypercube. By experiment: from 4 rounds on, the cycles of
# the permutation look random.
_ROUNDS = 6
_TAG = 0x51A7  # names the random stream of the points among those of case 0; any number would do


class Points(eqx.Module):
    """Abstract: case number -> point (d,) inside the unit cube."""

    @abc.abstractmethod
    def __call__(self, case: Any, dtype: Any) -> Float[Array, " d"]:
        """The point of `case`; no entry is 0 or 1, so that quantiles are finite."""


class Sobol(Points):
    """Sobol's sequence, scrambled, in the order of `scipy.stats.qmc.Sobol`.

    The scrambling is a random lower-triangular matrix over GF(2) and a digital shift for each
    dimension: every point is uniform on the cube, and the first 2^m keep their even spread.

    **Source:** Joe & Kuo, SIAM J. Sci. Comput. 30 (2008); Matousek, J. Complexity 14 (1998).
    """

    directions: UInt32[Array, "bits d"]
    shift: UInt32[Array, " d"]

    def __call__(self, case: Any, dtype: Any) -> Float[Array, " d"]:
        case = jnp.asarray(case).astype(jnp.uint32)
        gray = case ^ (case >> jnp.uint32(1))
        bits = (gray >> jnp.arange(_BITS, dtype=jnp.uint32)) & jnp.uint32(1)
        chosen = bits[:, None] * self.directions
        x = jax.lax.reduce(chosen, np.uint32(0), jax.lax.bitwise_xor, (0,))
        return _inside(x ^ self.shift, dtype)


class LatinHypercube(Points):
    """In every dimension, one point in each of `cases` layers, at random within its layer.

    The layers are permuted by a keyed bijection of [0, 2^b), 2^b >= `cases`, applied again until
    the number is below `cases`.

    **Source:** McKay, Beckman & Conover, Technometrics 21 (1979); the walk by Kensler, Pixar
    technical memo 13-01 (2013).
    """

    key: Array
    mixers: UInt32[Array, "rounds two d"]
    cases: int = eqx.field(static=True)

    def __call__(self, case: Any, dtype: Any) -> Float[Array, " d"]:
        layer = self.layer(case)
        within = jax.random.uniform(jax.random.fold_in(self.key, case), layer.shape, dtype)
        u = (layer.astype(dtype) + within) / jnp.asarray(self.cases, dtype)
        eps = jnp.finfo(dtype).eps
        return jnp.clip(u, eps / 4, 1 - eps / 2)

    def layer(self, case: Any) -> UInt32[Array, " d"]:
        """The layer of `case` in each dimension, an integer in [0, cases)."""
        x = jnp.broadcast_to(jnp.asarray(case).astype(jnp.uint32), self.mixers.shape[-1:])
        beyond = lambda x: x >= jnp.uint32(self.cases)
        walk = lambda x: jnp.where(beyond(x), self._mixed(x), x)
        return jax.lax.while_loop(lambda x: jnp.any(beyond(x)), walk, self._mixed(x))

    def _mixed(self, x: UInt32[Array, " d"]) -> UInt32[Array, " d"]:
        """A bijection of [0, 2^b): each step can be undone."""
        bits = max((self.cases - 1).bit_length(), 1)
        mask, half = jnp.uint32(2**bits - 1), jnp.uint32(max(bits // 2, 1))
        for added, factor in self.mixers:
            x = (x + added) & mask
            x = (x * factor) & mask  # odd factors have an inverse
            x = x ^ (x >> half)
        return x


def points(sampling: str, key: Array, dimensions: int, cases: int) -> Points | None:
    """The points of `cases` cases, randomised by `key`, that of case 0; None for "random".

    **Raises:** `ValueError` for another name, or more cases than 2^32.
    """
    if sampling not in SAMPLINGS:
        raise ValueError(f"sampling is {sampling!r}; choose one of {', '.join(SAMPLINGS)}.")
    if sampling == "random":
        return None
    if cases > 2**_BITS:
        raise ValueError(f"sampling {sampling!r} has 2^32 points; {cases} cases are too many.")
    k_points, k_within = jax.random.split(jax.random.fold_in(key, _TAG))
    if sampling == "latin_hypercube":
        mixers = jax.random.bits(k_points, (_ROUNDS, 2, dimensions), jnp.uint32)
        mixers = mixers.at[:, 1].set(mixers[:, 1] | jnp.uint32(1))
        return LatinHypercube(k_within, mixers, cases)
    plain = jnp.asarray(directions(dimensions))
    lower = jax.random.bits(k_points, (_BITS, dimensions), jnp.uint32)
    # Row i of the matrix gives bit i from the top: ones on the diagonal, chance above it.
    place = np.arange(_BITS, dtype=np.uint32)[::-1, None]
    one = np.uint32(1) << place
    row = (lower & jnp.asarray(~(one | (one - np.uint32(1))))) | jnp.asarray(one)
    odd = jax.lax.population_count(plain[None] & row[:, None]) & jnp.uint32(1)
    scrambled = jnp.sum(odd << jnp.asarray(place)[:, :, None], axis=0, dtype=jnp.uint32)
    return Sobol(scrambled, jax.random.bits(k_within, (dimensions,), jnp.uint32))


def directions(dimensions: int) -> np.ndarray:
    """Direction numbers (32, d) of Sobol's sequence, as SciPy has them.

    **Source:** Joe & Kuo, SIAM J. Sci. Comput. 30 (2008).
    """
    from scipy.stats import qmc

    # SciPy has no public name for them; a test compares the points made from them with SciPy's.
    table = qmc.Sobol(max(dimensions, 1), scramble=False, bits=_BITS)._sv
    return np.ascontiguousarray(table[:dimensions].T.astype(np.uint32))


def _inside(x: UInt32[Array, " d"], dtype: Any) -> Float[Array, " d"]:
    """The middle of each of 2^32 (float32: 2^23) intervals: neither 0 nor 1 after rounding."""
    bits = _BITS if jnp.finfo(dtype).nmant >= _BITS else jnp.finfo(dtype).nmant
    x = x >> jnp.uint32(_BITS - bits) if bits < _BITS else x
    return (x.astype(dtype) + jnp.asarray(0.5, dtype)) * jnp.asarray(2.0**-bits, dtype)
