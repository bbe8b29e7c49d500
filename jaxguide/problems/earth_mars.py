"""Low-thrust Earth-Mars transfer: the example of Yan, Fahroo & Ross (2002), eqs. (50)-(56)."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxguide.flight.mission import Mission
from jaxguide.laws.neighboring import NeighboringOptimal
from jaxguide.montecarlo.dispersions import Distribution, Normal
from jaxguide.neighboring.gains import gain_schedule
from jaxguide.problem import Problem
from jaxguide.problems.reference import Reference
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal
from jaxguide.trig import sincos


class EarthMars(Problem):
    """Reach the largest circular orbit at a fixed time by steering a constant thrust.

    Canonical units: LU and TU, so that mu = 1, and the initial mass. State r [LU], v_r, v_t
    [LU/TU]; control epsilon [rad], the angle of the thrust above the local horizontal. J = -r(tf).

    **Source:** Yan, Fahroo & Ross (2002), eqs. (50)-(56), after Bryson & Ho (1975).
    """

    thrust: ArrayLike = 0.1405
    mass_flow: ArrayLike = 0.0749
    mass: ArrayLike = 1.0
    mu: ArrayLike = 1.0
    state_names = ("r", "v_r", "v_t")
    control_names = ("epsilon",)
    initial_time = 0.0
    final_time = 3.32
    initial_state = (1.0, 0.0, 1.0)
    reference = Reference(
        -1.525277700649, 1e-11, "independent, two meshes", "Bryson & Ho (1975); yapss orbit_raising"
    )

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        r, v_r, v_t = x[0], x[1], x[2]
        sin, cos = sincos(u[0])
        # Equations of the 2002 paper.
        a = self.thrust / (self.mass - self.mass_flow * t)  # eq. (53)
        return jnp.stack(
            [
                v_r,  # eq. (50)
                v_t * v_t / r - self.mu / (r * r) + a * sin,  # eq. (51)
                -v_r * v_t / r + a * cos,  # eq. (52)
            ]
        )

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return -xf[0]

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return jnp.stack([xf[1], xf[2] - jnp.sqrt(self.mu / xf[0])])  # eq. (56)

    def optimal_control(self, t: Any, x: Any, costate: Any) -> Any:
        return jnp.arctan2(-costate[1], -costate[2])[None]


SAMPLE_INTERVAL = 0.02  # TU: 2002 paper, section 5
CAP = 0.3  # rad, bound of |du| in dispersed flights: chosen, as the paper has none


def mission(extremal: Extremal | None = None, cap: float = CAP, **options: Any) -> Mission:
    """The 2002 paper's closed loop: exact gains sampled every 0.02 TU, du held over the sample.

    **Arguments:** `extremal`: the nominal, solved for if absent; `cap` [rad]: bound of |du|;
    `options`: of `jg.Mission`.
    """
    extremal = solve(EarthMars()) if extremal is None else extremal
    tf = float(extremal.final_time)
    count = round(tf / SAMPLE_INTERVAL)
    schedule = gain_schedule(extremal, np.arange(count) * SAMPLE_INTERVAL)
    law = NeighboringOptimal(schedule, cap)
    return Mission(extremal.problem, law, extremal.x[0], SAMPLE_INTERVAL, **options)


def dispersions() -> dict[str, Distribution]:
    """The initial state dispersed by 1e-3 in each component, one sigma: about a third of the
    largest deviation in the 2002 paper, Table 1."""
    return {"initial_state": Normal(1e-3)}
