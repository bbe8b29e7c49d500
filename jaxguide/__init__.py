"""jaxguide: one differentiable line from a problem statement to flown dispersions.

Names are imported when first used: `import jaxguide` costs next to nothing, and the command line
can set the environment before JAX is loaded.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxguide import problems as problems
    from jaxguide import tuning as tuning
    from jaxguide.batch import solve_batch as solve_batch
    from jaxguide.bellman import Bellman as Bellman
    from jaxguide.bellman import bellman as bellman
    from jaxguide.certificate import Certificate as Certificate
    from jaxguide.certificate import certify as certify
    from jaxguide.flight.integrators import Adaptive as Adaptive
    from jaxguide.flight.integrators import RungeKutta4 as RungeKutta4
    from jaxguide.flight.mission import Mission as Mission
    from jaxguide.flight.simulate import Flight as Flight
    from jaxguide.flight.simulate import simulate as simulate
    from jaxguide.laws.holds import History as History
    from jaxguide.laws.holds import HoldControl as HoldControl
    from jaxguide.laws.holds import HoldDeviation as HoldDeviation
    from jaxguide.laws.law import Command as Command
    from jaxguide.laws.law import Law as Law
    from jaxguide.laws.law import OpenLoop as OpenLoop
    from jaxguide.laws.neighboring import NeighboringOptimal as NeighboringOptimal
    from jaxguide.laws.suboptimal import LinearGains as LinearGains
    from jaxguide.laws.suboptimal import NeighboringSuboptimal as NeighboringSuboptimal
    from jaxguide.laws.suboptimal import TimeToGo as TimeToGo
    from jaxguide.laws.suboptimal import TimeToGoGains as TimeToGoGains
    from jaxguide.montecarlo.compare import compare as compare
    from jaxguide.montecarlo.covariance import linear_covariance as linear_covariance
    from jaxguide.montecarlo.dispersions import LogNormal as LogNormal
    from jaxguide.montecarlo.dispersions import MultivariateNormal as MultivariateNormal
    from jaxguide.montecarlo.dispersions import Normal as Normal
    from jaxguide.montecarlo.dispersions import Relative as Relative
    from jaxguide.montecarlo.dispersions import TruncatedNormal as TruncatedNormal
    from jaxguide.montecarlo.dispersions import Uniform as Uniform
    from jaxguide.montecarlo.rollouts import rerun as rerun
    from jaxguide.montecarlo.rollouts import rollouts as rollouts
    from jaxguide.montecarlo.stopping import PercentileWithin as PercentileWithin
    from jaxguide.montecarlo.stopping import SuccessWithin as SuccessWithin
    from jaxguide.montecarlo.sweep import sweep as sweep
    from jaxguide.montecarlo.written import dispersions_from as dispersions_from
    from jaxguide.neighboring.gains import GainSchedule as GainSchedule
    from jaxguide.neighboring.gains import gain_schedule as gain_schedule
    from jaxguide.neighboring.linearization import LinearTPBVP as LinearTPBVP
    from jaxguide.neighboring.linearization import linearize as linearize
    from jaxguide.neighboring.suboptimal import SuboptimalSchedule as SuboptimalSchedule
    from jaxguide.neighboring.suboptimal import suboptimal_gains as suboptimal_gains
    from jaxguide.nominal.phased import Phased as Phased
    from jaxguide.nominal.phased import PhaseEnds as PhaseEnds
    from jaxguide.nominal.piecewise_linear import PiecewiseLinear as PiecewiseLinear
    from jaxguide.nominal.pseudospectral import Pseudospectral as Pseudospectral
    from jaxguide.nominal.shooting import Shooting as Shooting
    from jaxguide.nominal.state_as_time import StateAsTime as StateAsTime
    from jaxguide.problem import Free as Free
    from jaxguide.problem import Problem as Problem
    from jaxguide.solving import solve as solve
    from jaxguide.trajectory import Extremal as Extremal
    from jaxguide.trajectory import Trajectory as Trajectory
    from jaxguide.trig import sincos as sincos
    from jaxguide.tuning.loop import tune as tune
    from jaxguide.types import RESULTS as RESULTS
    from jaxguide.types import SolveError as SolveError

__version__ = "0.1.0"

_HOME = {
    "Adaptive": "flight.integrators",
    "Bellman": "bellman",
    "Certificate": "certificate",
    "Command": "laws.law",
    "Extremal": "trajectory",
    "Flight": "flight.simulate",
    "Free": "problem",
    "GainSchedule": "neighboring.gains",
    "History": "laws.holds",
    "HoldControl": "laws.holds",
    "HoldDeviation": "laws.holds",
    "Law": "laws.law",
    "LinearGains": "laws.suboptimal",
    "LinearTPBVP": "neighboring.linearization",
    "LogNormal": "montecarlo.dispersions",
    "Mission": "flight.mission",
    "MultivariateNormal": "montecarlo.dispersions",
    "NeighboringOptimal": "laws.neighboring",
    "NeighboringSuboptimal": "laws.suboptimal",
    "Normal": "montecarlo.dispersions",
    "OpenLoop": "laws.law",
    "PercentileWithin": "montecarlo.stopping",
    "PhaseEnds": "nominal.phased",
    "Phased": "nominal.phased",
    "PiecewiseLinear": "nominal.piecewise_linear",
    "Problem": "problem",
    "Pseudospectral": "nominal.pseudospectral",
    "RESULTS": "types",
    "Relative": "montecarlo.dispersions",
    "RungeKutta4": "flight.integrators",
    "Shooting": "nominal.shooting",
    "SolveError": "types",
    "StateAsTime": "nominal.state_as_time",
    "SuboptimalSchedule": "neighboring.suboptimal",
    "SuccessWithin": "montecarlo.stopping",
    "TimeToGo": "laws.suboptimal",
    "TimeToGoGains": "laws.suboptimal",
    "Trajectory": "trajectory",
    "TruncatedNormal": "montecarlo.dispersions",
    "Uniform": "montecarlo.dispersions",
    "bellman": "bellman",
    "certify": "certificate",
    "compare": "montecarlo.compare",
    "dispersions_from": "montecarlo.written",
    "gain_schedule": "neighboring.gains",
    "linear_covariance": "montecarlo.covariance",
    "linearize": "neighboring.linearization",
    "rerun": "montecarlo.rollouts",
    "rollouts": "montecarlo.rollouts",
    "simulate": "flight.simulate",
    "sincos": "trig",
    "solve": "solving",
    "solve_batch": "batch",
    "suboptimal_gains": "neighboring.suboptimal",
    "sweep": "montecarlo.sweep",
    "tune": "tuning.loop",
}
_MODULES = ("export", "plotting", "problems", "report", "reproduce", "tuning")


def __getattr__(name: str) -> object:
    if name in _HOME:
        value = getattr(importlib.import_module(f"jaxguide.{_HOME[name]}"), name)
    elif name in _MODULES:
        value = importlib.import_module(f"jaxguide.{name}")
    else:
        raise AttributeError(f"module 'jaxguide' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME, *_MODULES])
