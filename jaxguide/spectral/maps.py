r"""Domain transformations $\Gamma$ between the computational domain $\tau$ and time $t$."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.spectral.barycentric import Real, like

Number = Float[Real, ""] | float | int
Numbers = Float[Real, "*shape"] | float | int


class AbstractMap(eqx.Module):
    """An increasing map from tau on [-1, 1] or [-1, 1) to time.

    A map is a pytree of its fields; every method takes numbers or arrays of any shape, returns that
    shape, and is differentiable.
    """

    @abc.abstractmethod
    def __call__(self, tau: Numbers) -> Float[Array, "*shape"]:
        """Time at `tau`."""

    @abc.abstractmethod
    def inverse(self, t: Numbers) -> Float[Array, "*shape"]:
        """`tau` at time `t`."""

    @abc.abstractmethod
    def derivative(self, tau: Numbers) -> Float[Array, "*shape"]:
        """dt/dtau at `tau`: multiplies dynamics and integrands."""


class LinearMap(AbstractMap):
    r"""$t = (t_f + t_0)/2 + (t_f - t_0) \tau/2$, finite horizons.

    **Arguments:** `t0`, `tf`: ends [s]; may be traced, so that a free final time is differentiable.

    **Error:** a few eps times max(|t0|, |tf|); the ends map exactly.

    **Source:** Ross & Karpenko, review (2012), eq. (5).
    """

    t0: Number
    tf: Number

    def __call__(self, tau):
        tau = like(tau, self.t0)
        return self.t0 * ((1 - tau) / 2) + self.tf * ((1 + tau) / 2)

    def inverse(self, t):
        t = like(t, self.t0)
        return ((t - self.t0) - (self.tf - t)) / (self.tf - self.t0)

    def derivative(self, tau):
        tau = like(tau, self.t0)
        return jnp.full_like(tau, 1) * ((self.tf - self.t0) / 2)


class BilinearMap(AbstractMap):
    r"""$t = t_0 + s (1 + \tau)/(1 - \tau)$, infinite horizons: $[-1, 1) \to [t_0, \infty)$.

    **Arguments:** `t0`: start [s]; `scale`: s [s], the time at $\tau = 0$ after `t0` (the review
    takes 1); about the slowest time constant is a good choice.

    **Error:** a few eps in tau; in t, eps (t - t0)/s relative, which the pole at +1 implies.

    **Source:** Ross & Karpenko, review (2012), eq. (6).
    """

    t0: Number = 0.0
    scale: Number = 1.0

    def __call__(self, tau):
        tau = like(tau, self.t0)
        return self.t0 + self.scale * ((1 + tau) / (1 - tau))

    def inverse(self, t):
        # (t' - 1)/(t' + 1) of the review, written so that t = inf gives 1 with derivative 0.
        t = like(t, self.t0)
        return 1 - 2 / ((t - self.t0) / self.scale + 1)

    def derivative(self, tau):
        tau = like(tau, self.t0)
        return self.scale * (2 / (1 - tau) ** 2)
