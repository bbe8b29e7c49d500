"""W. A. Libby, "Neighboring Extremal Guidance for Systems with Piecewise Linear Control Using Time
as the Reference Variable" (University of Texas): the lunar launch, computed values beside printed
ones."""

import contextlib
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxguide.host.progress import NoProgress, Progress
from jaxguide.neighboring.suboptimal import (
    SuboptimalSchedule,
    remaining_optimum,
    suboptimal_gains,
)
from jaxguide.nominal.parametric.piecewise_linear import PiecewiseLinear
from jaxguide.problems import lunar_launch
from jaxguide.problems.lunar_launch import LunarLaunch
from jaxguide.reproduce.lunar_launch import sections
from jaxguide.reproduce.lunar_launch.flights import (
    ends,
    fly_plants,
    nowack_mission,
    optimal_times,
    printed_end,
    printed_nominal,
    thesis_mission,
)
from jaxguide.reproduce.lunar_launch.improvements import place_nodes, variants
from jaxguide.reproduce.report import Report
from jaxguide.reproduce.stages import Stages
from jaxguide.solving.solve import solve
from jaxguide.sweeping.sweep import sweep

SWEEP_CASES = 100_000  # the 1st and 99th percentiles to 0.012 standard deviations


def run(out: Path | None = None, progress: Progress | None = None) -> Report:
    """Every number of the thesis, and the improvements that its last chapter asks for; figures go
    to the folder `out`, if given."""
    report = Report("Lunar launch: neighbouring suboptimal guidance (Libby)")
    stages = Stages(report, NoProgress() if progress is None else progress, 6 + (out is not None))
    with contextlib.closing(stages):
        with stages("nominal"):
            printed, optimum = printed_nominal(), solve(LunarLaunch())
            converged = solve(LunarLaunch(), PiecewiseLinear())
            guesses = {k: solve(LunarLaunch(), PiecewiseLinear(k), optimum) for k in (5, 17, 33)}
            excess = {
                k: float(e.final_time - optimum.final_time)
                for k, e in sorted({**guesses, 9: converged}.items())
            }
        with stages("gains"):
            schedule = suboptimal_gains(printed, "whole")
            whole = suboptimal_gains(converged, "whole")
            remaining = suboptimal_gains(converged)
            errors = gain_differences(remaining)
        with stages("flights"):
            by_time, by_velocity = thesis_mission(printed), nowack_mission(converged)
            flown = {"t": fly_plants(by_time), "u": fly_plants(by_velocity)}
            optimal = np.asarray(optimal_times(converged))
        with stages("nodes by gradient"):
            thesis = ends(fly_plants(thesis_mission(converged)))
            placed = place_nodes(converged, thesis[:, 0])
        with stages("improvements"):
            better = {k: ends(fly_plants(m)) for k, m in variants(converged, placed).items()}
        with stages("sweep"):
            loop = lunar_launch.mission(converged)
            dataset = sweep(loop, lunar_launch.dispersions(), SWEEP_CASES, 0)
        sections.nominal(report, printed_end(printed), converged, optimum)
        sections.convergence(report, excess)
        sections.gain_tables(report, schedule, whole)
        sections.exactness(report, whole, remaining, errors)
        sections.flights(report, ends(flown["t"]), ends(flown["u"], True), optimal)
        sections.improvements(report, better, placed)
        sections.dispersed(report, dataset)
        if out is not None:
            from jaxguide.reproduce.lunar_launch.figures import write_figures

            with stages("figures"):
                loops = {"t": by_time, "u": by_velocity}
                report.figures = write_figures(out, loops, flown, better, placed, dataset)
    return report


# Steps of finite differences in y, u, v [ft, ft/s, ft/s]: truncation, of their square, and rounding
# balance (by experiment).
STEPS = (1.0, 0.1, 0.1)


def gain_differences(schedule: SuboptimalSchedule) -> np.ndarray:
    """How far the exact gains are from central differences of re-optimised parameters, by station:
    the largest difference, relative to the largest gain of its column."""
    extremal, stations = schedule.extremal, schedule.stations
    worst = np.zeros(stations.shape[0])
    for j, step in enumerate(STEPS, 1):
        dx = jnp.zeros((stations.shape[0], extremal.problem.n)).at[:, j].set(step)
        ahead, behind = (remaining_optimum(extremal, stations, s * dx) for s in (1.0, -1.0))
        slope = np.asarray(ahead - behind) / (2 * step)
        gains = np.concatenate([schedule.K[:, :, 0, j], schedule.K_time[:, None, j]], axis=1)
        for part in (slice(None, -1), slice(-1, None)):  # controls and time, in units of their own
            size = np.abs(gains[:, part]).max(axis=1)
            worst = np.maximum(worst, np.abs(slope - gains)[:, part].max(axis=1) / size)
    return worst
