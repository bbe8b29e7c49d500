"""Figures 5.1 to 5.8 of Libby's thesis, the improvements with their loss curve, the sweep."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from jaxguide import plotting as plot
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight
from jaxguide.reproduce.lunar_launch.flights import CASES, TABLES, TARGET, deviations

UNITS = {"t": "s", "x": "ft", "y": "ft", "u": "ft/s", "v": "ft/s", "theta": "rad"}
SCALES = np.array([50_000.0, 5_444.0, 5_444.0])  # of y, u, v: thesis, eq. (4.18)
SHOWN = {"5.3": "thrust acceleration", "5.4": "lunar gravity"}
PERCENT = 5.0  # perturbation shown; the thesis does not say which its figures show
PANELS = ("y", "v", "u", "norm of the error")


def write_figures(
    out: Path,
    loops: dict[str, Mission],
    flown: dict[str, Flight],
    ends: dict[str, Float[np.ndarray, "case 4"]],
    placed: Any,
    dataset: Any,
) -> list[str]:
    """Writes the figures to the folder `out` and returns their paths.

    **Arguments:** `loops`, `flown`: closed loops and their twenty flights, by reference variable
    ("t", "u"); `ends`: final time and deviations of y, u, v by law; `placed`: of `place_nodes`;
    `dataset`: of the sweep.
    """
    seen = {law: _seen(loops[law], flown[law], law == "u") for law in loops}
    figures = {
        "fig5-1-to-4-thrust": compared(seen, "5.3"),
        "fig5-5-to-8-gravity": compared(seen, "5.4"),
        "improvements": improved(ends, placed),
        "sweep": plot.plot_sweep(dataset, UNITS),
    }
    return [plot.save(figures[name], out / f"lunar-launch-{name}.png") for name in sorted(figures)]


def _seen(loop: Mission, flight: Flight, by_velocity: bool) -> tuple[np.ndarray, np.ndarray]:
    """Time of each update and the deviations of y, u, v from the nominal there, by case; NaN
    after the end."""
    t, x = np.asarray(flight.t), np.asarray(flight.x)
    if by_velocity:  # the clock is u itself, of which there is no deviation
        nominal: Any = loop.law
        nominal = np.asarray(nominal.schedule.extremal(t[0]).x)
        dx = x - nominal[None]
        return x[:, :, 3], np.stack([dx[:, :, 1], 0 * dx[:, :, 1], dx[:, :, 2]], axis=2)
    dx = np.asarray(deviations(loop, flight)[1])[:, :, 1:]
    off = np.concatenate([dx, x[:, -1:, 1:] - TARGET[None, None]], axis=1)
    over = np.concatenate([np.zeros((len(t), 1), bool), np.diff(t, axis=1) <= 0], axis=1)
    return t, np.where(over[:, :, None], np.nan, off)


@plot.styled
def compared(seen: dict[str, tuple[np.ndarray, np.ndarray]], table: str) -> Figure:
    """Thesis, figures 5.1 to 5.4 (`table` "5.3") or 5.5 to 5.8 ("5.4").

    **Arguments:** `seen`: times of the updates and deviations of y, u, v there, by reference
    variable.
    """
    figure = Figure(figsize=(plot.WIDTH, 4.6))
    axes = figure.subplots(2, 2, sharex=True)
    words = {"t": "time as reference", "u": "horizontal velocity as reference"}
    for panel, (axis, name) in enumerate(zip(axes.ravel(), PANELS, strict=True)):
        axis.axhline(0.0, color="#808080", linewidth=0.6)
        k = 0
        for law, (t, off) in seen.items():
            for percent in (-PERCENT, PERCENT):
                case = next(
                    i for i, c in enumerate(CASES) if (TABLES[i], c.percent) == (table, percent)
                )
                values = off[case]
                if name in ("y", "u", "v"):
                    shown = values[:, ("y", "u", "v").index(name)]
                else:
                    shown = np.linalg.norm(values / SCALES, axis=1)
                if name != "u" or law == "t":
                    text = f"{words[law]}, {percent:+g} %"
                    axis.plot(t[case], shown, label=text, **plot.line(k))
                k += 1
        label = plot.label(name, UNITS, r"\delta ") if panel < 3 else "norm of the error"
        axis.set_ylabel(label)
    for axis in axes[-1]:
        axis.set_xlabel("$t$ [s]")
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=2, title=f"Error of {SHOWN[table]}")
    return figure


@plot.styled
def improved(ends: dict[str, np.ndarray], placed: Any) -> Figure:
    """The error of y at the end by law, and the nodes placed by gradient with their loss."""
    figure = Figure(figsize=(plot.WIDTH, 3.4))
    panels = figure.subplot_mosaic([["errors", "loss"], ["errors", "nodes"]], height_ratios=(6, 1))
    errors, loss, nodes = panels["errors"], panels["loss"], panels["nodes"]
    order = np.argsort(
        [c.percent + (100 if t == "5.4" else 0) for t, c in zip(TABLES, CASES, strict=True)]
    )
    for k, (name, end) in enumerate(ends.items()):
        values = np.abs(end[order, 1])
        errors.semilogy(values, label=name, marker=plot.MARKERS[k], **plot.line(k))
    ticks = range(0, 20, 3)
    labels = [f"{TABLES[i][2] == '3' and 'a' or 'g'} {CASES[i].percent:+g}" for i in order]
    errors.set_xticks(list(ticks), [labels[i] for i in ticks], rotation=45)
    errors.set_ylabel("error of $y$ at the end [ft]")
    errors.set_xlabel("perturbation [%]")
    loss.semilogy(placed.losses, **plot.line(0))
    loss.set_xlabel("step of Adam")
    loss.set_ylabel("loss over twenty flights [ft$^2$]")
    loss.set_title("Nodes placed by gradient")
    nodes.vlines(placed.positions, 0.0, 1.0, color=plot.COLOURS[3])
    nodes.set_yticks([])
    nodes.grid(False)
    nodes.set_xlabel("nodes found, fractions of the horizon")
    handles = errors.get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=2)
    return figure
