"""Brachistochrones and other steering problems, and two with integral constraints.

Angles in radians, else without units. Constants are those of each problem's `reference.source`.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxguide.problem import Free, Problem
from jaxguide.problems.reference import Reference
from jaxguide.trig import sincos


class Brachistochrone(Problem):
    """Shortest time from rest at (0, 0) to (2, 2), y downwards, g = 9.8."""

    gravity: ArrayLike = 9.8
    target: tuple = (2.0, 2.0)
    state_names = ("x", "y", "v")
    control_names = ("theta",)
    initial_state = (0.0, 0.0, 0.0)
    final_time = Free(0.01, 100.0, 1.0)
    control_bounds = (0.0, jnp.pi)
    reference = Reference(0.824759143156625, 1e-15, "cycloid", "PSOPT brac1")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        sin, cos = sincos(u[0])
        return jnp.stack([x[2] * sin, x[2] * cos, self.gravity * cos])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return tf

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[0] - self.target[0], xf[1] - self.target[1]])


class BrachistochroneDymos(Brachistochrone):
    """Shortest time from rest over 10 across and 5 down, g = 9.80665."""

    gravity: ArrayLike = 9.80665
    target: tuple = (10.0, 5.0)
    reference = Reference(
        1.80160312245308, 1e-14, "cycloid", "dymos brachistochrone",
        trap="g = 9.81 gives 1.80129548301372",
    )  # fmt: skip


class BrachistochroneWall(Brachistochrone):
    """Shortest time from rest to x = 1 above the wall y <= x/2 + 0.1, g = 32.174."""

    gravity: ArrayLike = 32.174
    reference = Reference(0.323331164025862, 1e-14, "published", "yapss brachistochrone, wall")

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[0] - 1])

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1] - x[0] / 2 - 0.1])


class LinearTangentSteering(Problem):
    """A particle of constant thrust 100 reaches y = 5 at velocity (45, 0) soonest."""

    thrust: ArrayLike = 100.0
    state_names = ("y", "v_x", "v_y")
    control_names = ("theta",)
    initial_state = (0.0, 0.0, 0.0)
    final_time = Free(0.01, 100.0, 1.0)
    control_bounds = (-jnp.pi / 2, jnp.pi / 2)
    reference = Reference(0.554570878334603, 1e-15, "linear tangent law", "PSOPT lts; COPS")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        sin, cos = sincos(u[0])
        return jnp.stack([x[2], self.thrust * cos, self.thrust * sin])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return tf

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[0] - 5, xf[1] - 45, xf[2]])


class HangingChain(Problem):
    """A chain of length 4 from height 1 to height 3 over unit span: the least potential energy."""

    state_names = ("x",)
    control_names = ("slope",)
    initial_state = (1.0,)
    integral_bounds = (4.0, 4.0)
    reference = Reference(5.06848011099342, 1e-14, "catenary", "PSOPT chain")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return u

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return x[0] * jnp.sqrt(1 + u[0] ** 2)

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.sqrt(1 + u**2)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf - 3


class Isoperimetric(Problem):
    """The closed curve of unit length around the largest area, 1/(4 pi).

    "Time" is arc length; its centre is at the origin.
    """

    state_names = ("x", "y")
    control_names = ("t_x", "t_y")
    integral_bounds = (0.0, 0.0)
    path_bounds = (1.0, 1.0)
    state_bounds = (-1.0, 1.0)
    control_bounds = (-2.0, 2.0)
    initial_state = (Free(-1.0, 1.0, 0.1), Free(-1.0, 1.0, 0.1))
    reference = Reference(-0.0795774715459477, 1e-16, "1/(4 pi)", "yapss isoperimetric")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return u

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return (x[0] * u[1] - x[1] * u[0]) / 2

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        return x

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([u[0] ** 2 + u[1] ** 2])

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf - x0
