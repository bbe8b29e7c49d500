"""The style of all figures: colours, dashes, symbols, axes; and writing them to files.

Sizes of type, lines and markers were chosen by eye, for figures as wide as a page's text.
"""

import functools as ft
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

Units = Mapping[str, str] | None

# Okabe & Ito's colours (Color Universal Design, 2008), dark ones first: distinct to colour-blind
# readers. In grey, dashes tell lines apart.
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
    """Decorator: draws under this module's style; the caller's matplotlib settings stay."""

    @ft.wraps(draw)
    def call(*args: Any, **options: Any) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **options)

    return call


def save(figure: Figure, path: Path, dpi: float = 200.0) -> str:
    """Writes `figure` to `path`, whose ending gives the format, and returns the path.

    Folders are made as needed. The layout is computed here, once: `savefig` alone would draw the
    figure twice, the first time to lay it out.

    **Arguments:** `dpi`: dots per inch of raster formats.
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
    """Colour and dashes of the i-th line, as keywords of `Axes.plot`; they repeat after seven."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i % len(DASHES)]}


def symbol(name: str, prefix: str = "") -> str:
    """A name as TeX for Matplotlib: v_r as v with a subscript, Greek letters as symbols, other
    words as they are. `prefix`: TeX to stand before it, such as a delta."""
    head, _, tail = name.partition("_")
    short = re.fullmatch(r"[A-Za-z]", head) or head in _GREEK
    if not short or (tail and not re.fullmatch(r"[A-Za-z0-9]{1,3}", tail)):
        plain = name.replace("_", " ")
        return rf"${prefix}$ {plain}" if prefix else plain
    head = rf"\{head}" if head in _GREEK else head
    tail = rf"_{{{tail}}}" if tail else ""
    return f"${prefix}{head}{tail}$"


def costate_symbol(name: str) -> str:
    """The costate of the state `name`: lambda with the state's symbol as subscript."""
    inner = symbol(name)
    return rf"$\lambda_{{{inner[1:-1]}}}$" if inner.startswith("$") else rf"$\lambda$ of {inner}"


def label(name: str, units: Units, prefix: str = "") -> str:
    """`symbol` with its unit in brackets, if `units` has one."""
    unit = (units or {}).get(name, "")
    return f"{symbol(name, prefix)} [{unit}]" if unit else symbol(name, prefix)


def panel_grid(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, np.ndarray]:
    """A figure of `rows` x `columns` panels, each row `height` inches high, and its axes, shape
    (rows, columns). `options`: of `Figure.subplots`."""
    figure = Figure(figsize=(WIDTH if columns > 1 else 0.72 * WIDTH, height * rows))
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def time_axis(axes: np.ndarray, units: Units) -> None:
    """Labels the lowest row of `axes` with time."""
    for axis in axes[-1]:
        axis.set_xlabel(label("t", units))


def names_of(problem: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the states and of the controls of a Problem."""
    return tuple(problem.state_names), tuple(problem.control_names)
