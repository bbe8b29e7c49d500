"""Shuttle re-entry: the greatest crossrange, with and without a limit on heating (Betts)."""

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxguide.problem import Free, Problem
from jaxguide.problems.reference import Reference
from jaxguide.trig import sincos

_DEGREE = math.pi / 180


class ShuttleReentry(Problem):
    """From 260,000 ft to 80,000 ft with the greatest final latitude.

    State: altitude [ft], longitude, latitude [rad], speed [ft/s], flight path angle, azimuth [rad];
    controls: angle of attack, bank [rad].

    **Source:** Betts, *Practical Methods for Optimal Control* (2010), example 6.1.
    """

    mass: ArrayLike = 203000.0 / 32.174  # slug
    mu: ArrayLike = 0.14076539e17  # ft^3/s^2
    earth: ArrayLike = 20902900.0  # radius, ft
    density: ArrayLike = 0.002378  # of the air on the ground, slug/ft^3
    scale_height: ArrayLike = 23800.0  # ft
    area: ArrayLike = 2690.0  # of reference, ft^2
    state_names = ("h", "phi", "theta", "v", "gamma", "psi")
    control_names = ("alpha", "beta")
    initial_state = (260000.0, 0.0, 0.0, 25600.0, -_DEGREE, 90 * _DEGREE)
    final_time = Free(100.0, 4000.0, 2000.0)
    state_bounds = (
        (0.0, -math.pi, -89 * _DEGREE, 1000.0, -89 * _DEGREE, -math.pi),
        (300000.0, math.pi, 89 * _DEGREE, 40000.0, 89 * _DEGREE, math.pi),
    )
    control_bounds = ((-89 * _DEGREE, -89 * _DEGREE), (89 * _DEGREE, _DEGREE))
    reference = Reference(
        -0.595876076294, 1e-12, "independent, two meshes", "Betts example 6.1; PSOPT",
        trap="published .59588, .59628 and 34.14119 degrees",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        h, _, theta, v, gamma, psi = x
        alpha, beta = u
        degrees = alpha / _DEGREE
        r = self.earth + h
        q = self.density * jnp.exp(-h / self.scale_height) * v**2 / 2 * self.area / self.mass
        drag = q * (0.07854 - 6.1592e-3 * degrees + 6.21408e-4 * degrees**2)
        lift = q * (-0.20704 + 0.029244 * degrees)
        g = self.mu / r**2
        (s_g, c_g), (s_p, c_p), (s_t, c_t) = sincos(gamma), sincos(psi), sincos(theta)
        s_b, c_b = sincos(beta)
        return jnp.stack(
            [
                v * s_g,
                v / r * c_g * s_p / c_t,
                v / r * c_g * c_p,
                -drag - g * s_g,
                lift / v * c_b + c_g * (v / r - g / v),
                lift * s_b / (v * c_g) + v / r * c_g * s_p * s_t / c_t,
            ]
        )

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return -xf[2]

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[0] - 80000, xf[3] - 2500, xf[4] + 5 * _DEGREE])


class ShuttleReentryHeat(ShuttleReentry):
    """Shuttle re-entry with the leading edge heated by at most 70 BTU/ft^2/s.

    **Source:** Betts, *Practical Methods for Optimal Control* (2010), example 6.2.
    """

    path_bounds = (-math.inf, 70.0)
    reference = Reference(-0.534515, 2e-6, "independent, two meshes", "Betts example 6.2; dymos")

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        degrees = u[0] / _DEGREE
        shape = 1.0672181 + degrees * (
            -0.019213774 + degrees * (2.1286289e-4 - 1.0117249e-6 * degrees)
        )
        rho = self.density * jnp.exp(-x[0] / self.scale_height)
        return jnp.stack([17700 * jnp.sqrt(rho) * (1e-4 * x[3]) ** 3.07 * shape])
