"""Problems with linear dynamics and linear or quadratic cost, some with state constraints: nearly
all with an optimum in closed form.

Without units. Constants are those of each problem's `reference.source`.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxguide.problem import Problem
from jaxguide.problems.reference import Reference


class DoubleIntegratorEffort(Problem):
    """x'' = u, rest to rest over unit distance in unit time, J = int u^2/2."""

    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 0.0)
    reference = Reference(6.0, 1e-14, "u = 6 - 12 t", "PSOPT dqc (Ross)")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], u[0]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return u[0] ** 2 / 2

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[0] - 1, xf[1]])


class FreeEndVelocity(DoubleIntegratorEffort):
    """x'' = u, unit distance in unit time with any final velocity, J = int u^2/2."""

    reference = Reference(1.5, 1e-14, "u = 3 (1 - t)", "PSOPT mineng_free_vf")

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[0] - 1])


class BrysonDenham(Problem):
    """x'' = u from (0, 1) to (0, -1) in unit time under the ceiling x <= l, J = int u^2/2."""

    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 1.0)
    state_bounds = ((-jnp.inf, -jnp.inf), (1 / 9, jnp.inf))
    reference = Reference(
        4.0, 1e-14, "4/(9 l), l = 1/9", "Bryson & Ho (1975), section 3.11; PSOPT bryson_denham",
        trap="PSOPT prints 3.999539, 1.2e-4 low, and leaves the final time free",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], u[0]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return u[0] ** 2 / 2

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[0], xf[1] + 1])


class Beam(BrysonDenham):
    """The Bryson-Denham problem with x <= 0.1, |u| <= 10 and J = int u^2."""

    state_bounds = ((-jnp.inf, -jnp.inf), (0.1, jnp.inf))
    control_bounds = (-10.0, 10.0)
    reference = Reference(
        80 / 9, 1e-14, "8/(9 l), l = 0.1", "CTDirect.jl beam; bocop",
        trap="published 8.8986 and 8.89 are grid errors, up to 1.1e-3 high",
    )  # fmt: skip

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return u[0] ** 2


class ScalarRegulator(Problem):
    """x' = u from 1, J = int (x^2 + u^2)/2 over unit time."""

    state_names = ("x",)
    control_names = ("u",)
    initial_state = (1.0,)
    reference = Reference(
        0.380797077977882, 1e-15, "tanh(1)/2", "maptor lqr",
        trap="its printed 'literature' value is wrong from digit 13",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return u

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return (x[0] ** 2 + u[0] ** 2) / 2


class WeightedRegulator(Problem):
    """x' = -x + u from 1, J = x_f^2/2 + int x^2 + 0.1 u^2 over unit time."""

    state_names = ("x",)
    control_names = ("u",)
    initial_state = (1.0,)
    reference = Reference(0.231913974452245, 1e-15, "scalar Riccati equation", "pockit README")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return u - x

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return x[0] ** 2 + 0.1 * u[0] ** 2

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf[0] ** 2 / 2


class TwoThrusters(Problem):
    """x' = -x - u + v from -1 to 0 with u, v >= 0, J = int (u + v)^2 over unit time."""

    state_names = ("x",)
    control_names = ("u", "v")
    initial_state = (-1.0,)
    control_bounds = (0.0, jnp.inf)
    reference = Reference(0.313035285499331, 1e-15, "2/(e^2 - 1)", "CTDirect.jl simple_integrator")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([-x[0] - u[0] + u[1]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return (u[0] + u[1]) ** 2

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf


class Robbins(Problem):
    """x''' = u from (1, -2, 0) to rest at 0 in 10 with x >= 0, J = int 3 x + u^2/2.

    A state constraint of third order: the optimum touches it infinitely often.
    """

    weight: ArrayLike = 3.0
    state_names = ("x", "v", "a")
    control_names = ("u",)
    final_time = 10.0
    initial_state = (1.0, -2.0, 0.0)
    state_bounds = ((0.0, -jnp.inf, -jnp.inf), (jnp.inf, jnp.inf, jnp.inf))
    reference = Reference(
        19.432, 3e-3, "own; still rising with the mesh", "CTDirect.jl robbins",
        trap="infinitely many touches: only a loose tolerance is honest",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], x[2], u[0]])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return self.weight * x[0] + u[0] ** 2 / 2

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf
