"""Oscillators and other nonlinear regulators: boundary layers, singular arcs, chattering.

Without units. Constants are those of each problem's `reference.source`.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxguide.problem import Problem
from jaxguide.problems.reference import Reference


class Hypersensitive(Problem):
    """x' = -x^3 + u from 1 to 1.5 over a horizon of 10,000, J = int (x^2 + u^2)/2."""

    state_names = ("x",)
    control_names = ("u",)
    initial_state = (1.0,)
    final_time = 10_000.0
    reference = Reference(3.362056904943, 1e-12, "closed form of both layers", "GPOPS-II; pycollo")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return u - x**3

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return (x[0] ** 2 + u[0] ** 2) / 2

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf - 1.5


class Rayleigh(Problem):
    """Rayleigh's oscillator for 4.5 under u + x/6 <= 0, J = int u^2 + x^2."""

    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (-5.0, -5.0)
    final_time = 4.5
    reference = Reference(
        44.8044449, 1e-7, "independent, two meshes", "Betts; PSOPT rayleigh",
        trap="PSOPT's record 44.77625 is 6e-4 low",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], -x[0] + x[1] * (1.4 - 0.14 * x[1] ** 2) + 4 * u[0]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return u[0] ** 2 + x[0] ** 2

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([u[0] + x[0] / 6])


class VanDerPol(Problem):
    """Van der Pol's oscillator from (1, 0) for 2, J = int (x^2 + v^2 + u^2)/2."""

    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (1.0, 0.0)
    final_time = 2.0
    reference = Reference(
        1.0478069082, 1e-10, "independent, two meshes", "CTDirect.jl vanderpol",
        trap="published 1.047921 is a grid error",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return (x[0] ** 2 + x[1] ** 2 + u[0] ** 2) / 2


class Fuller(Problem):
    """x'' = u, |u| <= 1, from (0, 1) to rest at 0 in 3.5, J = int x^2: infinitely many switches."""

    limit: ArrayLike = 1.0
    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 1.0)
    final_time = 3.5
    control_bounds = (-1.0, 1.0)
    reference = Reference(0.2683939, 1e-7, "independent, two meshes", "CTDirect.jl fuller")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], self.limit * u[0]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return x[0] ** 2

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf


class Singular5(Problem):
    """Luus' fifth singular problem: x1' = x2, x2' = -x3 u + 16 t - 8, x3' = u, 0 <= u <= 10."""

    state_names = ("x1", "x2", "x3")
    control_names = ("u",)
    initial_state = (0.0, -1.0, -(5.0**0.5))
    control_bounds = (0.0, 10.0)
    reference = Reference(0.119248, 1e-6, "independent, two meshes", "PSOPT singular5")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], -x[2] * u[0] + 16 * t - 8, u[0]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        slow = x[1] + 16 * t - 8 - 0.1 * x[2] * u[0] ** 2
        return x[0] ** 2 + x[1] ** 2 + 0.0005 * slow**2
