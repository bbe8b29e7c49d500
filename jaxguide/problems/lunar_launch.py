"""Launch from the Moon into a low orbit in the least time: Libby's thesis, chapter 4."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxguide.flight.integrators import RungeKutta4
from jaxguide.flight.mission import Mission
from jaxguide.laws.gain_interpolation import Interpolation, TimeToGoGains
from jaxguide.laws.holds import History
from jaxguide.laws.suboptimal import TimeToGo
from jaxguide.montecarlo.dispersions import Distribution, Normal
from jaxguide.neighboring.suboptimal import suboptimal_gains
from jaxguide.nominal.parametric.piecewise_linear import PiecewiseLinear
from jaxguide.problem import Free, Problem
from jaxguide.problems.reference import Reference
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal
from jaxguide.trig import sincos


class LunarLaunch(Problem):
    """Least time from rest to 50,000 ft at 5,444 ft/s, level, by steering a constant thrust.

    Flat Moon, uniform gravity. State x, y [ft] (downrange, altitude), u, v [ft/s] (their rates);
    control theta [rad], the angle of the thrust above the horizontal. J = tf [s]. The optimum is
    the linear tangent law, tan(theta) = 0.48782613 - 0.00159492555 t.

    **Source:** W. A. Libby, *Neighboring Extremal Guidance for Systems with Piecewise Linear
    Control Using Time as the Reference Variable*, University of Texas, eqs. (4.1)-(4.9).
    """

    thrust: ArrayLike = 20.8  # acceleration, ft/s^2
    gravity: ArrayLike = 5.32  # ft/s^2
    orbit: tuple = (50_000.0, 5_444.0, 0.0)  # y [ft], u, v [ft/s] at the end
    state_names = ("x", "y", "u", "v")
    control_names = ("theta",)
    initial_state = (0.0, 0.0, 0.0, 0.0)
    final_time = Free(1.0, 5000.0, 300.0)
    reference = Reference(272.706049676, 1e-9, "linear tangent law", "Libby, section 4.1")

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        sin, cos = sincos(u[0])
        return jnp.stack([x[2], x[3], self.thrust * cos, self.thrust * sin - self.gravity])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return tf

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        y, u, v = self.orbit
        return jnp.stack([xf[1] - y, xf[2] - u, xf[3] - v])

    def optimal_control(self, t: Any, x: Any, costate: Any) -> Any:
        return jnp.arctan2(-costate[3], -costate[2])[None]


SAMPLE_INTERVAL = 4.0  # s: thesis, section 4.5
# Powers of the time to go by which gains grow: 2 of a position (y), 1 of a velocity (u, v), 0 of x,
# which has no gain.
POWERS = (0.0, 2.0, 1.0, 1.0)
QUIET = 1.0  # s before the end in which the correction is not updated (chosen)
MISS = (100.0, 2.0, 10.0)  # ft, ft/s, ft/s of y, u, v: further off, a flight has failed (chosen)


def mission(
    extremal: Extremal | None = None,
    form: Any = "remaining",
    interpolation: Interpolation | None = None,
    quiet: float = QUIET,
    **options: Any,
) -> Mission:
    """Closed loop with the time to go as reference, sampled every 4 s, one Runge-Kutta step each.

    By default with exact gains, interpolated scaled by the time to go, and the correction held in
    the last second. The thesis's own law is `form="whole", interpolation=LinearGains(), quiet=0.0,
    miss=None`.

    **Arguments:** `extremal`: the nominal, solved for if absent; `form`: of `jg.suboptimal_gains`;
    `interpolation`, `quiet` [s]: of `jg.TimeToGo`; `options`: of `jg.Mission`.
    """
    extremal = solve(LunarLaunch(), PiecewiseLinear()) if extremal is None else extremal
    interpolation = TimeToGoGains(jnp.asarray(POWERS)) if interpolation is None else interpolation
    law = TimeToGo(suboptimal_gains(extremal, form), interpolation, quiet=quiet)
    options = {"miss": MISS, "hold": History(), "integrator": RungeKutta4(1)} | options
    return Mission(extremal.problem, law, extremal.x[0], SAMPLE_INTERVAL, **options)


def dispersions() -> dict[str, Distribution]:
    """Thrust and gravity dispersed by 1 per cent, the initial position by 100 ft and the velocity
    by 10 ft/s in each component, one sigma (chosen)."""
    return {
        "plant.thrust": Normal(0.208),
        "plant.gravity": Normal(0.0532),
        "initial_state": Normal(jnp.asarray([100.0, 100.0, 10.0, 10.0])),
    }
