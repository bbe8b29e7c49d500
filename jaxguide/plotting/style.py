"""How figures look: colours, dashes, symbols, axes, and how they are written."""

import functools as ft
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

Units = Mapping[str, str] | None

# Okabe & Ito's colours, dark ones first: distinct to colour-blind readers, and in grey by dashes.
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (1.2, 1.2)),
    (0, (6, 1.5, 1.2, 1.5)),
    (0, (2.5, 1.2)),
    (0, (6, 1.2, 1.2, 1.2, 1.2, 1.2)),
    (0, (9, 2)),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
WIDTH = 6.5  # in, the text width of a page
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.linewidth": 0.4,
    "grid.color": "#d0d0d0",
    "axes.axisbelow": True,
    "legend.fontsize": 8.0,
    "legend.framealpha": 0.9,
    "legend.handlelength": 2.8,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.0,
    "axes.formatter.limits": (-3, 4),
    "figure.constrained_layout.use": True,
}
_GREEK = {"alpha", "beta", "gamma", "delta", "epsilon", "theta", "phi", "psi", "lambda", "mu"}


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Draws under this module's style, leaving the caller's matplotlib settings alone."""

    @ft.wraps(draw)
    def call(*args: Any, **options: Any) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **options)

    return call


def save(figure: Figure, path: Path, dpi: float = 200.0) -> str:
    """Writes `figure`, makes folders as needed, and returns the path.

    `savefig` alone would draw it twice, the first time to lay it out.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.set_dpi(dpi)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
    figure.savefig(path, dpi=dpi)
    return str(path)


def line(i: int) -> dict[str, Any]:
    """Colour and dashes of the i-th line."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i % len(DASHES)]}


def symbol(name: str, prefix: str = "") -> str:
    """A name as set type: v_r as v with a subscript, greek letters as such, words as words."""
    head, _, tail = name.partition("_")
    short = re.fullmatch(r"[A-Za-z]", head) or head in _GREEK
    if not short or (tail and not re.fullmatch(r"[A-Za-z0-9]{1,3}", tail)):
        plain = name.replace("_", " ")
        return rf"${prefix}$ {plain}" if prefix else plain
    head = rf"\{head}" if head in _GREEK else head
    tail = rf"_{{{tail}}}" if tail else ""
    return f"${prefix}{head}{tail}$"


def costate_symbol(name: str) -> str:
    """lambda with the state as its subscript."""
    inner = symbol(name)
    return rf"$\lambda_{{{inner[1:-1]}}}$" if inner.startswith("$") else rf"$\lambda$ of {inner}"


def label(name: str, units: Units, prefix: str = "") -> str:
    """`symbol` with its unit."""
    unit = (units or {}).get(name, "")
    return f"{symbol(name, prefix)} [{unit}]" if unit else symbol(name, prefix)


def panel_grid(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(WIDTH if columns > 1 else 0.72 * WIDTH, height * rows))
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def time_axis(axes: np.ndarray, units: Units) -> None:
    for axis in axes[-1]:
        axis.set_xlabel(label("t", units))


def names_of(problem: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return tuple(problem.state_names), tuple(problem.control_names)
