"""Yan, Fahroo & Ross, "Real-Time Computation of Neighboring Optimal Control Laws" (AIAA GNC, 2002):
the low-thrust Earth-Mars transfer, computed beside the paper's Table 2 and beside a reference.
"""

import contextlib
import importlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from jaxguide.host.lapack import one_thread
from jaxguide.host.progress import NoProgress, Progress
from jaxguide.neighboring.gains import gain_schedule
from jaxguide.problems import earth_mars
from jaxguide.problems.earth_mars import SAMPLE_INTERVAL, EarthMars
from jaxguide.reproduce.earth_mars import sections
from jaxguide.reproduce.earth_mars.ahead import compile_ahead
from jaxguide.reproduce.earth_mars.collocation import (
    relative_gain_errors,
    wrong_sign_histories,
    wrong_sign_systems,
)
from jaxguide.reproduce.earth_mars.flights import (
    METHOD,
    fly_variants,
    histories,
    reoptimise,
    stage_times,
)
from jaxguide.reproduce.earth_mars.published import CASES
from jaxguide.reproduce.report import Report
from jaxguide.reproduce.stages import Stages
from jaxguide.solving.solve import solve
from jaxguide.sweeping.sweep import sweep

SWEEP_CASES = 10_000  # standard deviations to 0.7 %, in a few seconds


def run(out: Path | None = None, progress: Progress | None = None) -> Report:
    """Every number and figure of the paper; figures go to the folder `out`, if given.

    Most of the time goes into tracing and compiling, so few programs are made, each of one shape.
    The work of NumPy and LAPACK runs in a second thread, and so do the six solves, whose program
    is at hand; all that is traced stays in one, because two threads that trace take turns at the
    interpreter (measured: three times as long in all).
    """
    report = Report("Earth-Mars transfer: neighbouring optimal control (Yan, Fahroo & Ross 2002)")
    stages = Stages(report, NoProgress() if progress is None else progress, 4 + (out is not None))
    times = np.arange(round(EarthMars.final_time / SAMPLE_INTERVAL)) * SAMPLE_INTERVAL
    instants = stage_times(times)
    pool = lambda: ThreadPoolExecutor(1)
    with contextlib.closing(stages), one_thread(), pool() as beside, pool() as ahead:
        with stages("nominal"):
            compile_ahead(ahead, times, instants, SWEEP_CASES)
            if out is not None:  # Matplotlib takes half a second
                ahead.submit(importlib.import_module, f"{__name__}.figures")
            extremal = solve(EarthMars(), METHOD)
        with stages("gains"):
            grids, systems = wrong_sign_systems(extremal, instants)
            wrong = beside.submit(wrong_sign_histories, grids, systems, instants)
            again = [beside.submit(reoptimise, case) for case in CASES]
            exact = gain_schedule(extremal, times)
            paper = gain_schedule(extremal, times, "least_squares", nodes=65)
            of_exact, of_paper = histories(exact, instants), histories(paper, instants)
            errors = relative_gain_errors(extremal)
        with stages("sweep"):
            mission = earth_mars.mission(extremal)
            dataset = sweep(mission, earth_mars.dispersions(), SWEEP_CASES, 0)
        with stages("six flights"):
            reoptimised = [found.result() for found in again]
            flights = fly_variants(exact, instants, of_exact, of_paper, wrong.result())
        sections.nominal(report, extremal)
        sections.gains(report, exact, paper)
        sections.gain_errors(report, errors)
        sections.table_2(report, flights, reoptimised)
        sections.wrong_sign(report, flights, reoptimised)
        sections.dispersed(report, dataset)
        if out is not None:
            from jaxguide.reproduce.earth_mars.figures import write_figures

            with stages("figures"):
                shown = (extremal, exact, flights["lstsq64_interp"], reoptimised, errors)
                report.figures = write_figures(out, *shown, dataset)
    return report
