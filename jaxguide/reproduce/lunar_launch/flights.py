"""The flights of Libby's thesis: twenty plants, two laws, and the optimum of each plant."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.certificate import Certified, certified
from jaxguide.flight.integrators import RungeKutta4
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, simulate
from jaxguide.laws.gain_interpolation import LinearGains
from jaxguide.laws.law import OpenLoop
from jaxguide.laws.suboptimal import NeighboringSuboptimal
from jaxguide.neighboring.suboptimal import suboptimal_gains
from jaxguide.nominal.parametric.extremal import parametric_extremal
from jaxguide.nominal.parametric.flow import pack
from jaxguide.nominal.parametric.piecewise_linear import PiecewiseLinear
from jaxguide.problems.lunar_launch import LunarLaunch, mission
from jaxguide.reproduce.lunar_launch.published import FINAL_TIME, TABLE_5_3, TABLE_5_4, THETA
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal
from jaxguide.transforms.state_as_time import StateAsTime

CASES = TABLE_5_3 + TABLE_5_4
_NAMES = ["5.3"] * len(TABLE_5_3) + ["5.4"] * len(TABLE_5_4)
TABLES = tuple(_NAMES)
# Exact percentages: the printed columns of thrust and gravity are rounded.
FACTORS = np.array([1 + case.percent / 100 for case in CASES])
# Nominal thrust acceleration and gravity [ft/s^2]: thesis, section 4.1.
THRUST = np.where(np.array(TABLES) == "5.3", 20.8 * FACTORS, 20.8)
GRAVITY = np.where(np.array(TABLES) == "5.4", 5.32 * FACTORS, 5.32)
TARGET = np.array([50_000.0, 5_444.0, 0.0])  # y [ft], u, v [ft/s]: thesis, section 4.1
# Equal steps of horizontal velocity (Nowack's law), and steps of time with which eq. (5.1) flown
# gives the digits of eqs. (5.2)-(5.6): both found by trial.
STEPS = 40


def printed_nominal() -> Certified:
    """The control of the thesis, eq. (5.1), flown: not quite the minimiser, but the trajectory
    about which the printed gains are computed."""
    problem, nodes = LunarLaunch(), np.linspace(0.0, 1.0, len(THETA))
    fly = lambda a: parametric_extremal(problem, nodes, a, None)
    parameters = pack(problem, jnp.asarray(THETA)[:, None], FINAL_TIME)
    return certified(eqx.filter_jit(fly)(parameters), PiecewiseLinear.accuracy)


def printed_end(nominal: Extremal) -> Flight:
    """Eq. (5.1) flown as the thesis seems to have flown it: Runge-Kutta 4 in 40 equal steps, which
    gives all digits of its eqs. (5.3)-(5.6); integrated exactly, y ends 4.9e-5 ft higher."""
    end = nominal.final_time
    loop = Mission(
        LunarLaunch(), OpenLoop(nominal), nominal.x[0], float(end) / STEPS, final_time=end,
        integrator=RungeKutta4(1),
    )  # fmt: skip
    return eqx.filter_jit(simulate)(loop, None, "ends")


def thesis_mission(extremal: Extremal, **options: Any) -> Mission:
    """Closed loop with time as the reference variable, thesis, chapter 4.

    **Arguments:** `options`: of `problems.lunar_launch.mission`.
    """
    options = {"quiet": 0.0, "miss": None} | options
    return mission(extremal, "whole", LinearGains(), **options)


def nowack_mission(nominal: Extremal) -> Mission:
    """Closed loop with horizontal velocity as the reference variable: nine nodes evenly spaced in
    it, the correction held over each step."""
    problem = StateAsTime(LunarLaunch(), "u", nominal)
    extremal = solve(problem, PiecewiseLinear())
    law = NeighboringSuboptimal(suboptimal_gains(extremal, "whole"))
    end = extremal.final_time
    options: dict[str, Any] = {"final_time": end, "integrator": RungeKutta4(1)}
    return Mission(problem, law, extremal.x[0], float(end) / STEPS, **options)


@eqx.filter_jit
def fly_plants(loop: Mission, save: str = "samples") -> Flight:
    """The flights of all twenty plants, batched. `save`: as in `jg.simulate`."""

    def one(thrust: Array, gravity: Array) -> Flight:
        plant = loop.plant
        inner = plant.problem if isinstance(plant, StateAsTime) else plant
        changed = dataclasses.replace(inner, thrust=thrust, gravity=gravity)
        where = lambda m: m.plant.problem if isinstance(plant, StateAsTime) else m.plant
        return simulate(eqx.tree_at(where, loop, changed), None, save)

    return jax.vmap(one)(jnp.asarray(THRUST), jnp.asarray(GRAVITY))


def ends(flight: Flight, by_velocity: bool = False) -> Float[np.ndarray, "case 4"]:
    """Final time [s], and deviations of y [ft], u and v [ft/s] from the target; `by_velocity`: the
    flight's clock is u, and time is its fourth state."""
    final = np.asarray(flight.final_state)
    if not by_velocity:
        return np.column_stack([flight.final_time, final[:, 1:] - TARGET[None]])
    y, v, t = final[:, 1] - TARGET[0], final[:, 2], final[:, 3]
    return np.column_stack([t, y, np.asarray(flight.final_time) - TARGET[1], v])


@eqx.filter_jit
def optimal_times(nominal: Extremal) -> Float[Array, " case"]:
    """Final time [s] of every plant's own nine-node optimum, batched, with the nominal as guess."""

    def one(thrust: Array, gravity: Array) -> Array:
        problem = dataclasses.replace(LunarLaunch(), thrust=thrust, gravity=gravity)
        return solve(problem, PiecewiseLinear(), nominal, throw=False).final_time

    return jax.vmap(one)(jnp.asarray(THRUST), jnp.asarray(GRAVITY))


@eqx.filter_jit
def deviations(loop: Mission, flight: Flight) -> tuple[Array, Array]:
    """Reference time and deviation from the nominal at each sample, as the law computes them, by
    case."""
    law: Any = loop.law
    schedule = law.schedule

    def one(flight: Flight) -> tuple[Array, Array]:
        def sample(memory: Any, item: tuple) -> tuple[Any, tuple[Array, Array]]:
            t, x = item
            command, memory = law(t, x, memory)
            reference = t - command.plan.offset
            tau = (reference - schedule.initial_time) / schedule.duration
            return memory, (reference, x - schedule.state(tau))

        items = (flight.t[:-1], flight.x[:-1])
        return jax.lax.scan(sample, law.start(flight.x[0]), items)[1]

    return jax.vmap(one)(flight)
