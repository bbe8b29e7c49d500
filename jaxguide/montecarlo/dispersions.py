"""Distributions of the deviation of any leaf of a Mission."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array

from jaxguide.types import is_traced

# Share of the largest entry by which an eigenvalue may be negative: of a singular covariance,
# rounding makes it n eps.
_SINGULAR = 1e-12


class Distribution(eqx.Module):
    """Abstract: the deviation that is added to one leaf of a Mission, in the units of the leaf.

    A subclass gives `sample` and `covariance`; with `quantile` it can also be drawn evenly
    (`sampling="sobol"`, `"latin_hypercube"`).
    """

    independent: ClassVar[bool] = True  # whether the entries of a draw are independent

    @abc.abstractmethod
    def sample(self, key: Array, shape: tuple[int, ...], dtype: Any) -> Array:
        """One draw of the given shape and type, from a PRNG key."""

    @abc.abstractmethod
    def covariance(self, size: int, dtype: Any) -> Array:
        """Covariance (size, size) of the flattened draw, in the leaf's units squared."""

    def quantile(self, u: Array) -> Array:
        """The draw whose distribution function is `u` (for correlated entries: of the independent
        normal numbers behind them). If `u`, of the leaf's shape and type, is uniform on (0, 1), the
        draw is distributed as a `sample` is.

        **Raises:** `ValueError` for a subclass that does not define it.
        """
        raise ValueError(
            f"{type(self).__name__} has no quantile, which evenly spread cases need; define one, "
            'or choose sampling="random".'
        )

    def deviation(self, key: Array, leaf: Array, u: Array | None = None) -> Array:
        """The draw that is added to `leaf`: `quantile(u)` if `u` is given, else a `sample`."""
        return self.sample(key, leaf.shape, leaf.dtype) if u is None else self.quantile(u)

    def spread(self, leaf: Array) -> Array:
        """Covariance (size, size) of the flattened `deviation` of `leaf`."""
        return self.covariance(leaf.size, leaf.dtype)


class Normal(Distribution):
    """Independent normal deviations; `std` and `mean` broadcast to the leaf."""

    std: Any
    mean: Any = 0.0

    def __check_init__(self):
        if not is_traced(self.std) and not np.all(np.asarray(self.std) >= 0):
            raise ValueError(f"Normal: std is {self.std}; give numbers >= 0.")

    def sample(self, key: Array, shape: tuple[int, ...], dtype: Any) -> Array:
        std, mean = _fit(self.std, shape, dtype, "std"), _fit(self.mean, shape, dtype, "mean")
        return mean + std * jax.random.normal(key, shape, dtype)

    def quantile(self, u: Array) -> Array:
        std = _fit(self.std, u.shape, u.dtype, "std")
        return _fit(self.mean, u.shape, u.dtype, "mean") + std * ndtri(u)

    def covariance(self, size: int, dtype: Any) -> Array:
        return jnp.diag(_fit(self.std, (size,), dtype, "std") ** 2)


class Uniform(Distribution):
    """Independent uniform deviations on [lo, hi]."""

    lo: Any
    hi: Any

    def __check_init__(self):
        if not is_traced((self.lo, self.hi)) and not np.all(np.asarray(self.lo) <= self.hi):
            raise ValueError(f"Uniform: lo={self.lo} lies above hi={self.hi}; exchange them.")

    def sample(self, key: Array, shape: tuple[int, ...], dtype: Any) -> Array:
        lo, hi = _fit(self.lo, shape, dtype, "lo"), _fit(self.hi, shape, dtype, "hi")
        return lo + (hi - lo) * jax.random.uniform(key, shape, dtype)

    def quantile(self, u: Array) -> Array:
        lo = _fit(self.lo, u.shape, u.dtype, "lo")
        return lo + (_fit(self.hi, u.shape, u.dtype, "hi") - lo) * u

    def covariance(self, size: int, dtype: Any) -> Array:
        width = _fit(self.hi, (size,), dtype, "hi") - _fit(self.lo, (size,), dtype, "lo")
        return jnp.diag(width**2 / 12)


class TruncatedNormal(Distribution):
    """Independent normal deviations of `std` about `mean`, truncated to [`lo`, `hi`].

    **Source:** of the variance: Johnson, Kotz & Balakrishnan, Continuous Univariate Distributions 1
    (1994), chapter 13.
    """

    std: Any
    lo: Any
    hi: Any
    mean: Any = 0.0

    def __check_init__(self):
        if not is_traced(self.std) and not np.all(np.asarray(self.std) > 0):
            raise ValueError(f"TruncatedNormal: std is {self.std}; give numbers > 0.")
        if not is_traced((self.lo, self.hi)) and not np.all(np.asarray(self.lo) < self.hi):
            raise ValueError(f"TruncatedNormal: lo={self.lo} is not below hi={self.hi}.")

    def _standard(self, shape: tuple[int, ...], dtype: Any) -> tuple[Array, ...]:
        std, mean = _fit(self.std, shape, dtype, "std"), _fit(self.mean, shape, dtype, "mean")
        lo, hi = _fit(self.lo, shape, dtype, "lo"), _fit(self.hi, shape, dtype, "hi")
        return std, mean, (lo - mean) / std, (hi - mean) / std

    def sample(self, key: Array, shape: tuple[int, ...], dtype: Any) -> Array:
        std, mean, a, b = self._standard(shape, dtype)
        return mean + std * jax.random.truncated_normal(key, a, b, shape, dtype)

    def quantile(self, u: Array) -> Array:
        std, mean, a, b = self._standard(u.shape, u.dtype)
        # Computed in the lower tail, where probabilities near 0 keep their relative precision.
        flip = a > 0
        low, high = jnp.where(flip, -b, a), jnp.where(flip, -a, b)
        p, q = jax.scipy.stats.norm.cdf(low), jax.scipy.stats.norm.cdf(high)
        z = jnp.clip(ndtri(p + jnp.where(flip, 1 - u, u) * (q - p)), low, high)
        return mean + std * jnp.where(flip, -z, z)

    def covariance(self, size: int, dtype: Any) -> Array:
        std, _, a, b = self._standard((size,), dtype)
        pdf, cdf = jax.scipy.stats.norm.pdf, jax.scipy.stats.norm.cdf
        end = lambda z: jnp.where(jnp.isfinite(z), z, 0.0) * pdf(z)
        inside = cdf(b) - cdf(a)
        shift = (pdf(a) - pdf(b)) / inside
        return jnp.diag(std**2 * (1 + (end(a) - end(b)) / inside - shift**2))


class LogNormal(Distribution):
    r"""Independent deviations $e^{\sigma z} - 1$, z standard normal; within `Relative`, the leaf is
    multiplied by $e^{\sigma z}$."""

    sigma: Any

    def __check_init__(self):
        if not is_traced(self.sigma) and not np.all(np.asarray(self.sigma) >= 0):
            raise ValueError(f"LogNormal: sigma is {self.sigma}; give numbers >= 0.")

    def sample(self, key: Array, shape: tuple[int, ...], dtype: Any) -> Array:
        sigma = _fit(self.sigma, shape, dtype, "sigma")
        return jnp.expm1(sigma * jax.random.normal(key, shape, dtype))

    def quantile(self, u: Array) -> Array:
        return jnp.expm1(_fit(self.sigma, u.shape, u.dtype, "sigma") * ndtri(u))

    def covariance(self, size: int, dtype: Any) -> Array:
        square = _fit(self.sigma, (size,), dtype, "sigma") ** 2
        return jnp.diag(jnp.expm1(square) * jnp.exp(square))


class Relative(Distribution):
    """The draws of `distribution` times the leaf: those of `Relative(Normal(0.01))` have a standard
    deviation of one per cent of it."""

    distribution: Distribution

    @property
    def independent(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.distribution.independent

    def sample(self, key: Array, shape: tuple[int, ...], dtype: Any) -> Array:
        return self.distribution.sample(key, shape, dtype)

    def covariance(self, size: int, dtype: Any) -> Array:
        return self.distribution.covariance(size, dtype)

    def quantile(self, u: Array) -> Array:
        return self.distribution.quantile(u)

    def deviation(self, key: Array, leaf: Array, u: Array | None = None) -> Array:
        return leaf * self.distribution.deviation(key, leaf, u)

    def spread(self, leaf: Array) -> Array:
        size = leaf.reshape(-1)
        return size[:, None] * self.distribution.spread(leaf) * size[None, :]


class MultivariateNormal(Distribution):
    """Correlated normal deviations of a vector leaf, from their covariance (n, n)."""

    cov: Any
    mean: Any = 0.0
    independent: ClassVar[bool] = False

    def __check_init__(self):
        if is_traced(self.cov):
            return
        cov = np.asarray(self.cov, float)
        if cov.ndim != 2 or cov.shape[0] != cov.shape[1] or not np.allclose(cov, cov.T):
            raise ValueError(f"MultivariateNormal: cov must be square and symmetric, got\n{cov}.")
        if np.linalg.eigvalsh(cov)[0] < -_SINGULAR * np.abs(cov).max():
            raise ValueError(f"MultivariateNormal: cov has a negative eigenvalue:\n{cov}.")

    def sample(self, key: Array, shape: tuple[int, ...], dtype: Any) -> Array:
        return self._coloured(jax.random.normal(key, shape, dtype))

    def quantile(self, u: Array) -> Array:
        return self._coloured(ndtri(u))

    def _coloured(self, white: Array) -> Array:
        # The symmetric square root also serves a singular covariance.
        cov = jnp.asarray(self.cov, white.dtype)
        if white.shape != (cov.shape[0],):
            raise ValueError(
                f"MultivariateNormal: cov is {cov.shape}, but the leaf has shape {white.shape}."
            )
        values, vectors = jnp.linalg.eigh(cov)
        root = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None, :]
        return _fit(self.mean, white.shape, white.dtype, "mean") + root @ white

    def covariance(self, size: int, dtype: Any) -> Array:
        return jnp.asarray(self.cov, dtype)


def _fit(value: Any, shape: tuple[int, ...], dtype: Any, name: str) -> Array:
    value = jnp.asarray(value, dtype)
    try:
        return jnp.broadcast_to(value, shape)
    except ValueError as e:
        raise ValueError(f"{name} of shape {value.shape} does not fit a leaf of {shape}.") from e
