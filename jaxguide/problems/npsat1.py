"""NPSAT1, a small satellite steered by magnets, on an air bearing: the example of Ross, Sekhavat,
Fleming & Gong (2006)."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxguide.problem import Free, Problem
from jaxguide.problems.reference import Reference

_HALF = jnp.pi * 135 / 360  # half the slew angle: 135 degrees about the vertical


class NPSAT1(Problem):
    """Turn a satellite on an air bearing by 135 degrees, rest to rest, in the least time.

    State: quaternion q1 ... q4 (scalar last) and body rates omega [rad/s]; controls: dipole moments
    u [A m^2] of three magnetic torquers. The mass hangs below the bearing's centre: a pendulum of
    `weight_moment` [N m], some 250 times the torque of the magnets. J = tf [s].

    The final q4 follows from |q| = 1, which the dynamics keep. Bounds of q and omega are far from
    active; the solver takes its units from them.

    **Source:** Ross, Sekhavat, Fleming & Gong (2006), eqs. (31)-(38), magnetic field in tesla.
    """

    inertia: tuple = (2.60, 2.87, 1.45)  # kg m^2
    weight_moment: ArrayLike = 59.0 * 9.81 * 0.56e-3  # N m
    field: tuple = (0.24970e-4, 0.09993e-4, 0.39280e-4)  # T, local frame
    state_names = ("q1", "q2", "q3", "q4", "omega1", "omega2", "omega3")
    control_names = ("u1", "u2", "u3")
    initial_state = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    final_time = Free(1.0, 400.0, 120.0)
    state_bounds = (
        (-1.1, -1.1, -1.1, 0.0, -0.05, -0.05, -0.2),
        (1.1, 1.1, 1.1, 1.1, 0.05, 0.05, 0.2),
    )
    control_bounds = (-33.0, 33.0)
    reference = Reference(
        112.0520402913, 1e-9, "Newton on 14 switching times",
        "Ross, Sekhavat, Fleming & Gong (2006)",
        trap="B is given in gauss; mgl wants g = 9.81",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        q1, q2, q3, q4, w1, w2, w3 = (x[i] for i in range(7))
        I1, I2, I3 = (jnp.asarray(self.inertia)[i] for i in range(3))
        # The local frame's axes seen from the body: columns of the direction cosine matrix.
        s1, s2, s3, s4 = q1 * q1, q2 * q2, q3 * q3, q4 * q4
        C13, C23 = 2 * (q1 * q3 - q2 * q4), 2 * (q2 * q3 + q1 * q4)
        C1 = jnp.stack([s1 - s2 - s3 + s4, 2 * (q1 * q2 - q3 * q4), 2 * (q1 * q3 + q2 * q4)])
        C2 = jnp.stack([2 * (q1 * q2 + q3 * q4), s2 - s1 - s3 + s4, 2 * (q2 * q3 - q1 * q4)])
        C3 = jnp.stack([C13, C23, s3 - s1 - s2 + s4])
        B1, B2, B3 = (jnp.asarray(self.field)[i] for i in range(3))
        B = B1 * C1 + B2 * C2 + B3 * C3
        mgl = self.weight_moment
        return jnp.stack(
            [
                (w1 * q4 - w2 * q3 + w3 * q2) / 2,
                (w1 * q3 + w2 * q4 - w3 * q1) / 2,
                (-w1 * q2 + w2 * q1 + w3 * q4) / 2,
                (-w1 * q1 - w2 * q2 - w3 * q3) / 2,
                ((I2 - I3) * w2 * w3 - mgl * C23 + B[2] * u[1] - B[1] * u[2]) / I1,
                ((I3 - I1) * w1 * w3 + mgl * C13 + B[0] * u[2] - B[2] * u[0]) / I2,
                ((I1 - I2) * w1 * w2 + B[1] * u[0] - B[0] * u[1]) / I3,
            ]
        )

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return tf

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        target = jnp.asarray([0.0, 0.0, jnp.sin(_HALF)], xf.dtype)
        return jnp.concatenate([xf[:3] - target, xf[4:]])
