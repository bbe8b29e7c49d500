"""Rockets, robots and gliders. Constants are those of each problem's `reference.source`."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxguide.problem import Free, Problem
from jaxguide.problems.reference import Reference
from jaxguide.trig import sincos


class MoonLander(Problem):
    """Soft landing from h = 10, v = -2 with 0 <= u <= 3 and g = 1.5, J = int u."""

    gravity: ArrayLike = 1.5
    state_names = ("h", "v")
    control_names = ("u",)
    initial_state = (10.0, -2.0)
    final_time = Free(0.1, 100.0, 4.0)
    control_bounds = (0.0, 3.0)
    reference = Reference(8.24621125123532, 1e-14, "coast, then full thrust", "mpopt README")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([x[1], u[0] - self.gravity])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return u[0]

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf


class Goddard(Problem):
    """Goddard's rocket (COPS): the highest altitude, scaled; boost, singular arc, coast."""

    drag: ArrayLike = 310.0
    thrust: ArrayLike = 3.5
    state_names = ("h", "v", "m")
    control_names = ("throttle",)
    initial_state = (1.0, 0.0, 1.0)
    final_time = Free(0.01, 1.0, 0.2)
    state_bounds = ((1.0, 0.0, 0.6), (2.0, 2.0, 1.0))
    control_bounds = (0.0, 1.0)
    reference = Reference(
        -1.01283693, 2e-8, "independent, arcs as phases", "COPS; OptimalControlProblems.jl rocket",
        trap="unstructured collocation overshoots to 1.0128452",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        h, v, m = x[0], x[1], x[2]
        thrust = self.thrust * u[0]
        drag = self.drag * v**2 * jnp.exp(-500 * (h - 1))
        return jnp.stack([v, (thrust - drag) / m - 1 / h**2, -2 * thrust])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return -xf[0]

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[2] - 0.6])


class GoddardSpeedLimit(Goddard):
    """Goddard's rocket with v <= 0.1."""

    state_bounds = ((1.0, 0.0, 0.6), (2.0, 0.1, 1.0))
    reference = Reference(
        -1.0125827647, 1e-10, "independent, arcs as phases", "CTDirect.jl goddard"
    )


class RobotArm(Problem):
    """A telescopic arm turns by 2 pi/3 from rest to rest in the shortest time (COPS)."""

    length: ArrayLike = 5.0
    state_names = ("rho", "theta", "phi", "rho_rate", "theta_rate", "phi_rate")
    control_names = ("u_rho", "u_theta", "u_phi")
    initial_state = (4.5, 0.0, jnp.pi / 4, 0.0, 0.0, 0.0)
    final_time = Free(0.1, 100.0, 10.0)
    control_bounds = (-1.0, 1.0)
    state_bounds = (
        (0.0, -jnp.pi, 0.0, -jnp.inf, -jnp.inf, -jnp.inf),
        (5.0, jnp.pi, jnp.pi, jnp.inf, jnp.inf, jnp.inf),
    )
    reference = Reference(
        9.140911745915, 1e-11, "independent, arcs as phases", "COPS; maptor robot_arm",
        trap="published 9.1409362 and 9.14138 are above this feasible solution",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        sin, _ = sincos(x[2])
        I_phi = ((self.length - x[0]) ** 3 + x[0] ** 3) / 3
        accelerations = (u[0] / self.length, u[1] / (I_phi * sin**2), u[2] / I_phi)
        return jnp.stack([x[3], x[4], x[5], *accelerations])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return tf

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf - jnp.asarray([4.5, 2 * jnp.pi / 3, jnp.pi / 4, 0.0, 0.0, 0.0], xf.dtype)


class FreeFlyingRobot(Problem):
    """Two pairs of thrusters bring a robot to rest at the origin in 12 on the least fuel."""

    arm: ArrayLike = 0.2
    state_names = ("x", "y", "theta", "v_x", "v_y", "omega")
    control_names = ("u1", "u2", "u3", "u4")
    initial_state = (-10.0, -10.0, jnp.pi / 2, 0.0, 0.0, 0.0)
    final_time = 12.0
    control_bounds = (0.0, 1.0)
    path_bounds = (-jnp.inf, 1.0)
    reference = Reference(
        7.91014705112, 1e-10, "independent, two meshes", "Sakawa (1999); Betts; pycollo",
        trap="both published values are above this feasible solution",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        sin, cos = sincos(x[2])
        left, right = u[0] - u[1], u[2] - u[3]
        force = left + right
        return jnp.stack([x[3], x[4], x[5], force * cos, force * sin, self.arm * (left - right)])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.sum(u)

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.stack([u[0] + u[1], u[2] + u[3]])

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf


class HangGlider(Problem):
    """A hang glider crosses a thermal: the longest range on the way from 1000 m to 900 m.

    State: range, altitude [m], and their rates [m/s]; control: lift coefficient. J = -x(tf).
    """

    mass: ArrayLike = 100.0  # kg
    gravity: ArrayLike = 9.80665  # m/s^2
    area: ArrayLike = 14.0  # of the wing, m^2
    density: ArrayLike = 1.13  # of the air, kg/m^3
    updraft: ArrayLike = 2.5  # at the thermal's centre, m/s
    radius: ArrayLike = 100.0  # of the thermal, m
    state_names = ("x", "y", "v_x", "v_y")
    control_names = ("c_L",)
    initial_state = (0.0, 1000.0, 13.2275675, -1.28750052)
    final_time = Free(0.1, 200.0, 100.0)
    state_bounds = ((0.0, 0.0, 0.0, -4.0), (1500.0, 1100.0, 15.0, 4.0))
    control_bounds = (0.0, 1.4)
    reference = Reference(
        -1248.031, 1e-3, "independent, two meshes", "Bulirsch et al. (1993); maptor hang_glider",
        trap="g = 9.81 gives 1247.9874",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        v_x, v_y, c_L = x[2], x[3], u[0]
        along = (x[0] / self.radius - 2.5) ** 2
        w = v_y - self.updraft * (1 - along) * jnp.exp(-along)
        # Lift and drag by the velocity relative to the air; maptor takes their size from the ground
        # speed, which gives 1247.872 on the mesh that gives 1248.0307 here.
        v = jnp.sqrt(v_x**2 + w**2)
        q = self.density * self.area * v**2 / 2 / self.mass
        lift, drag = c_L * q, (0.034 + 0.069662 * c_L**2) * q
        sin, cos = w / v, v_x / v
        return jnp.stack(
            [v_x, v_y, -lift * sin - drag * cos, lift * cos - drag * sin - self.gravity]
        )

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return -xf[0]

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf[1:] - jnp.asarray([900.0, 13.2275675, -1.28750052], xf.dtype)
