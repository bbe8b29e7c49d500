"""jaxguide: one differentiable line from a problem statement to flown dispersions.

Names are imported when first used: `import jaxguide` costs next to nothing, and the command line
can set the environment before JAX is loaded.
"""

import gc
import importlib
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxguide import problems as problems
    from jaxguide import tuning as tuning
    from jaxguide.certificate import Certificate as Certificate
    from jaxguide.certificate import Certified as Certified
    from jaxguide.certificate import certify as certify
    from jaxguide.flight.actuators import Actuator as Actuator
    from jaxguide.flight.actuators import ControlLimits as ControlLimits
    from jaxguide.flight.disturbances import Disturbance as Disturbance
    from jaxguide.flight.estimators import Estimate as Estimate
    from jaxguide.flight.estimators import Estimator as Estimator
    from jaxguide.flight.integrators import Adaptive as Adaptive
    from jaxguide.flight.integrators import Integrator as Integrator
    from jaxguide.flight.integrators import RungeKutta4 as RungeKutta4
    from jaxguide.flight.mission import Mission as Mission
    from jaxguide.flight.sensors import Sensor as Sensor
    from jaxguide.flight.simulate import Flight as Flight
    from jaxguide.flight.simulate import simulate as simulate
    from jaxguide.laws.gain_interpolation import LinearGains as LinearGains
    from jaxguide.laws.gain_interpolation import TimeToGoGains as TimeToGoGains
    from jaxguide.laws.holds import History as History
    from jaxguide.laws.holds import HoldControl as HoldControl
    from jaxguide.laws.holds import HoldDeviation as HoldDeviation
    from jaxguide.laws.law import Command as Command
    from jaxguide.laws.law import Hold as Hold
    from jaxguide.laws.law import Law as Law
    from jaxguide.laws.law import OpenLoop as OpenLoop
    from jaxguide.laws.neighboring import NeighboringOptimal as NeighboringOptimal
    from jaxguide.laws.suboptimal import NeighboringSuboptimal as NeighboringSuboptimal
    from jaxguide.laws.suboptimal import TimeToGo as TimeToGo
    from jaxguide.montecarlo.covariance import linear_covariance as linear_covariance
    from jaxguide.montecarlo.dispersions import LogNormal as LogNormal
    from jaxguide.montecarlo.dispersions import MultivariateNormal as MultivariateNormal
    from jaxguide.montecarlo.dispersions import Normal as Normal
    from jaxguide.montecarlo.dispersions import Relative as Relative
    from jaxguide.montecarlo.dispersions import TruncatedNormal as TruncatedNormal
    from jaxguide.montecarlo.dispersions import Uniform as Uniform
    from jaxguide.montecarlo.rollouts import rerun as rerun
    from jaxguide.montecarlo.rollouts import rollouts as rollouts
    from jaxguide.neighboring.gains import GainSchedule as GainSchedule
    from jaxguide.neighboring.gains import gain_schedule as gain_schedule
    from jaxguide.neighboring.linearization import LinearTPBVP as LinearTPBVP
    from jaxguide.neighboring.linearization import linearize as linearize
    from jaxguide.neighboring.suboptimal import SuboptimalSchedule as SuboptimalSchedule
    from jaxguide.neighboring.suboptimal import suboptimal_gains as suboptimal_gains
    from jaxguide.nominal.direct.pseudospectral import Pseudospectral as Pseudospectral
    from jaxguide.nominal.indirect.shooting import Shooting as Shooting
    from jaxguide.nominal.method import Capabilities as Capabilities
    from jaxguide.nominal.method import Method as Method
    from jaxguide.nominal.parametric.piecewise_linear import PiecewiseLinear as PiecewiseLinear
    from jaxguide.problem import Free as Free
    from jaxguide.problem import Problem as Problem
    from jaxguide.solving.batch import solve_batch as solve_batch
    from jaxguide.solving.bellman import Bellman as Bellman
    from jaxguide.solving.bellman import bellman as bellman
    from jaxguide.solving.solve import solve as solve
    from jaxguide.spectral.families import NodeFamily as NodeFamily
    from jaxguide.sweeping.compare import compare as compare
    from jaxguide.sweeping.stopping import PercentileWithin as PercentileWithin
    from jaxguide.sweeping.stopping import SuccessWithin as SuccessWithin
    from jaxguide.sweeping.sweep import sweep as sweep
    from jaxguide.sweeping.written import dispersions_from as dispersions_from
    from jaxguide.trajectory import Extremal as Extremal
    from jaxguide.trajectory import Multipliers as Multipliers
    from jaxguide.trajectory import Trajectory as Trajectory
    from jaxguide.transforms.phased import Phased as Phased
    from jaxguide.transforms.phased import PhaseEnds as PhaseEnds
    from jaxguide.transforms.state_as_time import StateAsTime as StateAsTime
    from jaxguide.trig import sincos as sincos
    from jaxguide.tuning.loop import tune as tune
    from jaxguide.types import RESULTS as RESULTS
    from jaxguide.types import SolveError as SolveError
    from jaxguide.types import SolveWarning as SolveWarning

__version__ = "0.1.0"

_HOME = {
    "Actuator": "flight.actuators",
    "Adaptive": "flight.integrators",
    "Bellman": "solving.bellman",
    "Capabilities": "nominal.method",
    "Certificate": "certificate",
    "Certified": "certificate",
    "Command": "laws.law",
    "ControlLimits": "flight.actuators",
    "Disturbance": "flight.disturbances",
    "Estimate": "flight.estimators",
    "Estimator": "flight.estimators",
    "Extremal": "trajectory",
    "Flight": "flight.simulate",
    "Free": "problem",
    "GainSchedule": "neighboring.gains",
    "History": "laws.holds",
    "Hold": "laws.law",
    "HoldControl": "laws.holds",
    "HoldDeviation": "laws.holds",
    "Integrator": "flight.integrators",
    "Law": "laws.law",
    "LinearGains": "laws.gain_interpolation",
    "LinearTPBVP": "neighboring.linearization",
    "LogNormal": "montecarlo.dispersions",
    "Method": "nominal.method",
    "Mission": "flight.mission",
    "Multipliers": "trajectory",
    "MultivariateNormal": "montecarlo.dispersions",
    "NeighboringOptimal": "laws.neighboring",
    "NeighboringSuboptimal": "laws.suboptimal",
    "NodeFamily": "spectral.families",
    "Normal": "montecarlo.dispersions",
    "OpenLoop": "laws.law",
    "PercentileWithin": "sweeping.stopping",
    "PhaseEnds": "transforms.phased",
    "Phased": "transforms.phased",
    "PiecewiseLinear": "nominal.parametric.piecewise_linear",
    "Problem": "problem",
    "Pseudospectral": "nominal.direct.pseudospectral",
    "RESULTS": "types",
    "Relative": "montecarlo.dispersions",
    "RungeKutta4": "flight.integrators",
    "Sensor": "flight.sensors",
    "Shooting": "nominal.indirect.shooting",
    "SolveError": "types",
    "SolveWarning": "types",
    "StateAsTime": "transforms.state_as_time",
    "SuboptimalSchedule": "neighboring.suboptimal",
    "SuccessWithin": "sweeping.stopping",
    "TimeToGo": "laws.suboptimal",
    "TimeToGoGains": "laws.gain_interpolation",
    "Trajectory": "trajectory",
    "TruncatedNormal": "montecarlo.dispersions",
    "Uniform": "montecarlo.dispersions",
    "bellman": "solving.bellman",
    "certify": "certificate",
    "compare": "sweeping.compare",
    "dispersions_from": "sweeping.written",
    "gain_schedule": "neighboring.gains",
    "linear_covariance": "montecarlo.covariance",
    "linearize": "neighboring.linearization",
    "rerun": "montecarlo.rollouts",
    "rollouts": "montecarlo.rollouts",
    "simulate": "flight.simulate",
    "sincos": "trig",
    "solve": "solving.solve",
    "solve_batch": "solving.batch",
    "suboptimal_gains": "neighboring.suboptimal",
    "sweep": "sweeping.sweep",
    "tune": "tuning.loop",
}
_MODULES = ("export", "plotting", "problems", "report", "reproduce", "tuning")


def __getattr__(name: str) -> object:
    if name in _HOME:
        value = getattr(_imported(_HOME[name]), name)
    elif name in _MODULES:
        value = _imported(name)
    else:
        raise AttributeError(f"module 'jaxguide' has no attribute {name!r}")
    globals()[name] = value
    return value


def _imported(name: str) -> ModuleType:
    """The module, imported without Python's cyclic garbage collector: it would take a seventh of
    the time, and find nothing."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        return importlib.import_module(f"jaxguide.{name}")
    finally:
        if collecting:
            gc.enable()


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME, *_MODULES])
