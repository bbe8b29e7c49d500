"""Figures 2 to 9 of the 2002 paper; the gains, their errors, the sweep; an overview."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxguide import plotting as plot
from jaxguide.flight.simulate import Flight
from jaxguide.neighboring.gains import GainSchedule
from jaxguide.reproduce.earth_mars.published import CASES, STATES, UNITS
from jaxguide.trajectory import Extremal


def write_figures(
    out: Path,
    extremal: Extremal,
    schedule: GainSchedule,
    flights: Flight,
    reoptimised: list[Extremal],
    errors: dict[str, dict[float, dict[int, float]]],
    dataset: Any,
) -> list[str]:
    """Writes the figures to the folder `out` and returns their paths.

    **Arguments:** `flights`: the six cases, batched; `errors`: of `relative_gain_errors`;
    `dataset`: of the sweep.
    """
    labels = []
    for k, case in enumerate(CASES):
        i = int(np.argmax(np.abs(case)))
        symbol = plot.symbol(STATES[i], r"\delta ")
        labels.append(rf"{k + 1}: {symbol}(0) = ${case[i]:g}$ {UNITS[STATES[i]]}")
    times = np.asarray(flights.t)[0]
    again = np.stack([plot.at(e, times)[0] for e in reoptimised])
    panels = {}
    for tau in (0.0, 2.0):
        title = f"K({tau:g})"
        panels[title] = {
            name: (list(errors[name][tau]), list(errors[name][tau].values())) for name in errors
        }
    figures = {
        "fig2-nominal": plot.plot_extremal(extremal, UNITS),
        "fig3-feedback": plot.plot_deviations(flights, extremal, "epsilon", labels, UNITS),
        "fig4-to-6-states": plot.plot_deviations(flights, extremal, STATES, labels, UNITS),
        "fig7-to-9-reoptimised": plot.plot_reoptimised(
            flights, again, STATES, STATES, labels, UNITS
        ),
        "gains": plot.plot_gains(schedule, UNITS),
        "gain-errors": plot.plot_gain_errors(panels),
        "overview": overview(extremal, schedule, dataset),
        "sweep": plot.plot_sweep(dataset, UNITS),
    }
    return [plot.save(figures[name], out / f"earth-mars-{name}.png") for name in sorted(figures)]


@plot.styled
def overview(extremal: Extremal, schedule: GainSchedule, dataset: Any) -> Figure:
    """The transfer with its thrust, the gains, and the ends of dispersed flights."""
    figure = Figure(figsize=(9.0, 3.1))
    orbit, gains, ends = figure.subplots(1, 3)

    t = np.linspace(0.0, float(extremal.final_time), 401)
    x, u = plot.at(extremal, t)
    rate = x[:, 2] / x[:, 0]  # of the polar angle
    angle = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(t))])
    cos, sin = np.cos(angle), np.sin(angle)
    circle = np.linspace(0.0, 2 * np.pi, 181)
    for k, radius in ((1, x[0, 0]), (2, x[-1, 0])):
        round_trip = radius * np.cos(circle), radius * np.sin(circle)
        orbit.plot(*round_trip, **plot.line(k), label=f"r = {radius:.4g} LU")
    orbit.plot(x[:, 0] * cos, x[:, 0] * sin, **plot.line(0), label="transfer")
    some = slice(0, None, 20)
    radial, transverse = np.sin(u[:, 0]), np.cos(u[:, 0])
    arrows = radial * cos - transverse * sin, radial * sin + transverse * cos
    orbit.quiver(
        (x[:, 0] * cos)[some], (x[:, 0] * sin)[some], arrows[0][some], arrows[1][some],
        color=plot.COLOURS[3], width=0.007, scale=9.0, zorder=3, label="thrust",
    )  # fmt: skip
    orbit.set_aspect("equal")
    orbit.set_title("Nominal: the largest orbit in 3.32 TU")
    orbit.legend(loc="center")
    orbit.set_xlabel("LU")

    times, K = np.asarray(schedule.times), np.asarray(schedule.K)[:, 0]
    for i, state in enumerate(STATES):
        above, below = (plot.symbol(name, r"\partial ") for name in ("epsilon", state))
        name = f"{above} / {below}"
        gains.plot(times, K[:, i], label=name, **plot.line(i))
    gains.set_yscale("symlog", linthresh=10.0)
    gains.set_title("Neighbouring-optimal gains")
    gains.set_xlabel("t [TU]")
    gains.legend(loc="upper left")

    good = np.asarray(dataset["result"]) == 0
    final = np.asarray(dataset["final_state"])[good] - np.asarray(extremal.x)[-1]
    start = (np.asarray(dataset["initial_state"])[good] - np.asarray(extremal.x)[0])[:, 0]
    bins = np.linspace(-0.012, 0.012, 61)  # by eye: all ends but a few, 0.4e-3 a bin
    circular = (
        final[:, 2]
        + np.sqrt(1 / float(np.asarray(extremal.x)[-1, 0]))
        - np.sqrt(1 / (float(np.asarray(extremal.x)[-1, 0]) + final[:, 0]))
    )
    for k, (values, text) in enumerate(
        ((start, "start: $\\delta r(0)$"), (final[:, 0], "end: $\\delta r(t_f)$"),
         (circular, "end: $v_t-\\sqrt{\\mu/r}$"))
    ):  # fmt: skip
        kind = plot.line(k) | {"linewidth": 1.2}
        ends.hist(values, bins=bins, histtype="step", label=text, **kind)
    ends.set_yscale("log")
    ends.set_title(f"{int(good.sum()):,} dispersed flights")
    ends.set_xlabel("LU, LU/TU")
    ends.set_ylabel("flights")
    ends.set_ylim(0.7, 2e6)  # room for the legend
    ends.legend(loc="upper center")
    return figure
