"""Figures of extremals, gains, flights and sweeps. Host only; no pyplot, so no display is needed.

Each `plot_` function returns a `matplotlib.figure.Figure`; `save` writes it. Every line has its own
dash pattern as well as its own colour, so that figures survive a black and white printer. `units`
maps names of states and controls, and "t", to units shown on the axes.
"""

import functools as ft
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxguide.spectral.grids import evaluation

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


def _grid(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(WIDTH if columns > 1 else 0.72 * WIDTH, height * rows))
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def _time_axis(axes: np.ndarray, units: Units) -> None:
    for axis in axes[-1]:
        axis.set_xlabel(label("t", units))


def _names(problem: Any) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return tuple(problem.state_names), tuple(problem.control_names)


@styled
def plot_extremal(extremal: Any, units: Units = None) -> Figure:
    """Control, states and costates of an Extremal (2002 paper, figure 2; the costates beside)."""
    states, controls = _names(extremal.problem)
    breaks, reference, pieces = _pieces(extremal)
    # Between the nodes too, which lie far apart on a mesh that has moved elsewhere.
    tau = np.linspace(-1.0, 1.0, 24)
    t = ((breaks[1:] + breaks[:-1])[:, None] + np.diff(breaks)[:, None] * tau).reshape(-1) / 2
    fine = np.concatenate(evaluation(reference, tau) @ pieces)
    n = len(states)
    panels = (
        ("control", fine[:, n:-n], controls, ""),
        ("state", fine[:, :n], states, ""),
        ("costate", fine[:, -n:], states, r"\lambda"),
    )
    figure, axes = _grid(3, 1, 2.1, sharex=True)
    for axis, (what, values, names, prefix) in zip(axes[:, 0], panels, strict=True):
        for i, name in enumerate(names):
            text = symbol(name) if not prefix else costate_symbol(name)
            unit = "" if prefix else (units or {}).get(name, "")
            axis.plot(t, values[:, i], label=f"{text} [{unit}]" if unit else text, **line(i))
        axis.set_ylabel(label(names[0], units) if len(names) == 1 and not prefix else what)
        if len(names) > 1 or prefix:
            axis.legend(loc="best")
    axes[0, 0].set_xlim(t[0], t[-1])
    _time_axis(axes, units)
    return figure


@styled
def plot_gains(schedule: Any, units: Units = None) -> Figure:
    """Gains against time on a symmetric logarithmic scale, and their error estimate below."""
    states, controls = _names(schedule.extremal.problem)
    t, K = np.asarray(schedule.times), np.asarray(schedule.K)
    figure, axes = _grid(len(controls) + 1, 1, 2.3, sharex=True)
    for i, control in enumerate(controls):
        axis = axes[i, 0]
        for j, state in enumerate(states):
            above, below = symbol(control, r"\partial "), symbol(state, r"\partial ")
            axis.plot(t, K[:, i, j], label=f"{above} / {below}", **line(j))
        # Linear up to the median size: gains to a hard end grow without bound.
        size = np.abs(K[:, i][np.isfinite(K[:, i])])
        axis.set_yscale("symlog", linthresh=10.0 ** np.round(np.log10(np.median(size) + 1e-300)))
        axis.set_ylabel(f"gain of {symbol(control)}")
        axis.legend(loc="best")
    error = np.asarray(schedule.error)
    resolved = np.asarray(schedule.resolved)
    below = axes[-1, 0]
    below.semilogy(t, np.maximum(error, 1e-17), **line(0))
    if not resolved.all():
        below.semilogy(t[~resolved], error[~resolved], "x", color=COLOURS[2], label="not resolved")
        below.legend(loc="best")
    below.set_ylabel("relative error, estimated")
    axes[0, 0].set_xlim(t[0], float(np.asarray(schedule.extremal.t)[-1]))
    _time_axis(axes, units)
    return figure


@styled
def plot_flight(flight: Any, extremal: Any, units: Units = None) -> Figure:
    """States and controls of one Flight over its nominal (left), and their difference (right)."""
    states, controls = _names(extremal.problem)
    t, x = np.asarray(flight.t), np.asarray(flight.x)
    x_nominal, u_nominal = at(extremal, t)
    u, du = np.asarray(flight.u), np.asarray(flight.commands)
    figure, axes = _grid(len(states) + len(controls), 2, 1.45, sharex=True)
    rows = [(name, x[:, i], x_nominal[:, i], None) for i, name in enumerate(states)]
    rows += [(name, u[:, i], u_nominal[:, i], du[:, i]) for i, name in enumerate(controls)]
    for (left, right), (name, flown, nominal, deviation) in zip(axes, rows, strict=True):
        left.plot(t, nominal, label="nominal", **line(1))
        left.plot(t[: len(flown)], flown, label="flown", **line(0))
        left.set_ylabel(label(name, units))
        if deviation is None:
            right.plot(t, flown - nominal, **line(0))
        else:
            right.step(t[:-1], deviation, where="post", **line(0))
        right.set_ylabel(label(name, units, r"\delta "))
    axes[0, 0].legend(loc="best")
    axes[0, 0].set_xlim(t[0], t[-1])
    _time_axis(axes, units)
    return figure


@styled
def plot_deviations(
    flights: Any,
    extremal: Any,
    names: str | Sequence[str],
    labels: Sequence[str] | None = None,
    units: Units = None,
) -> Figure:
    """Deviations from the nominal of several flights (2002 paper, figures 3 to 6).

    **Arguments:** `flights`: a Flight with a leading case axis; `names`: of states (their
    deviation) or controls (the commanded feedback), a panel each; `labels`: one a case.

    **Raises:** `ValueError` for a name that is neither.
    """
    states, controls = _names(extremal.problem)
    t = np.asarray(flights.t)[0]
    dx = np.asarray(flights.x) - at(extremal, t)[0][None]
    panels = []
    for name in _tuple(names):
        if name in states:
            values, when = dx[:, :, states.index(name)], t
        elif name in controls:
            values, when = np.asarray(flights.commands)[:, :, controls.index(name)], t[:-1]
        else:
            raise ValueError(f"{name!r} is no state {states} and no control {controls}.")
        panels.append((when, values, label(name, units, r"\delta ")))
    return _cases(panels, labels, units)


@styled
def plot_reoptimised(
    flights: Any,
    reoptimised: np.ndarray,
    names: str | Sequence[str],
    state_names: Sequence[str],
    labels: Sequence[str] | None = None,
    units: Units = None,
) -> Figure:
    """Flown minus re-optimised states (2002 paper, figures 7 to 9).

    **Arguments:** `flights`: a Flight with a leading case axis; `reoptimised` (case, sample+1, n):
    states, at the same times, of the extremals from the perturbed starts; `names`: of states, a
    panel each.
    """
    states = tuple(state_names)
    off = np.asarray(flights.x) - np.asarray(reoptimised)
    panels = []
    for name in _tuple(names):
        if name not in states:
            raise ValueError(f"{name!r} is no state; there are {states}.")
        unit = (units or {}).get(name, "")
        text = f"{symbol(name)} minus\nre-optimised" + (f" [{unit}]" if unit else "")
        panels.append((np.asarray(flights.t)[0], off[:, :, states.index(name)], text))
    return _cases(panels, labels, units)


def _tuple(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _cases(
    panels: Sequence[tuple[np.ndarray, np.ndarray, str]],
    labels: Sequence[str] | None,
    units: Units,
) -> Figure:
    """A panel for each (times, values by case, text), all with the same cases."""
    cases = len(panels[0][1])
    labels = [f"case {k + 1}" for k in range(cases)] if labels is None else labels
    figure, axes = _grid(len(panels), 1, 3.4 if len(panels) == 1 else 2.2, sharex=True)
    for axis, (t, values, text) in zip(axes[:, 0], panels, strict=True):
        axis.axhline(0.0, color="#808080", linewidth=0.6)
        for k, (row, text_k) in enumerate(zip(values, labels, strict=True)):
            axis.plot(t, row, label=text_k, **line(k))
        axis.set_xlim(t[0], t[-1])
        axis.set_ylabel(text)
    _time_axis(axes, units)
    # Six curves leave no free corner, so the legend stands above.
    handles = axes[0, 0].get_legend_handles_labels()
    columns = 2 if len(labels) > 3 else 1
    figure.legend(*handles, loc="outside upper center", ncols=columns)
    return figure


@styled
def plot_gain_errors(
    errors: Mapping[str, Mapping[str, tuple[Any, Any]]],
    abscissa: str = "collocation points",
    ordinate: str = "error of the gain, relative",
) -> Figure:
    """Error of gains against the size of the discretisation, one panel for each time.

    **Arguments:** `errors`: panel title -> method -> (points, errors).
    """
    figure, axes = _grid(1, len(errors), 3.0, sharey=True)
    for axis, (title, methods) in zip(axes[0], errors.items(), strict=True):
        for k, (method, (points, values)) in enumerate(methods.items()):
            values = np.maximum(np.asarray(values, float), 1e-17)
            axis.loglog(points, values, marker=MARKERS[k], label=method, **line(k))
        axis.set_title(title)
        axis.set_xlabel(abscissa)
        sizes = [int(p) for points, _ in methods.values() for p in points]
        ticks = [2**k for k in range(20) if min(sizes) <= 1.1 * 2**k and 2**k <= 1.1 * max(sizes)]
        axis.set_xticks(ticks, [str(p) for p in ticks])
        axis.minorticks_off()
    axes[0, 0].set_ylabel(ordinate)
    axes[0, 0].legend(loc="best")
    return figure


@styled
def plot_sweep(dataset: Any, units: Units = None) -> Figure:
    """Final states of a sweep: histograms on the diagonal, pairs below it.

    The pairs carry three-sigma ellipses of the sampled covariance and, dashed, of the linear one;
    the histograms, the 1st, 50th and 99th percentiles. Failed cases are counted in the title.
    """
    names = [str(s) for s in np.asarray(dataset["state"])]
    good = np.isfinite(np.asarray(dataset["final_state"])).all(axis=1)
    good &= np.asarray(dataset["result"]) == 0
    finals = np.asarray(dataset["final_state"], float)[good]
    attrs = dataset.attrs
    n = len(names)
    figure = Figure(figsize=(WIDTH, 0.86 * WIDTH))
    axes = figure.subplots(n, n, squeeze=False)
    # Final states scatter by little about large values: show them from the undispersed end.
    nominal = np.asarray(attrs["nominal_final_state"], float)
    values = finals - nominal[None, :]
    sampled = np.asarray(attrs["sample_covariance"], float)
    linear = np.asarray(attrs["linear_covariance"], float)
    mean = values.mean(axis=0) if len(values) else np.zeros(n)
    for i in range(n):
        for j in range(n):
            axis: Axes = axes[i, j]
            if j > i:
                axis.set_visible(False)
            elif j == i:
                _histogram(axis, values[:, i])
                axis.yaxis.tick_right()
            elif len(values):
                axis.plot(
                    values[:, j], values[:, i], ".", color="#9a9a9a", markersize=1.5, alpha=0.4,
                    markeredgewidth=0, rasterized=True, zorder=1,
                )  # fmt: skip
                pair = np.ix_([j, i], [j, i])
                ellipse(axis, mean[[j, i]], sampled[pair], label="sampled", **line(0))
                ellipse(axis, np.zeros(2), linear[pair], label="linear", **line(2))
            axis.locator_params(nbins=4)
    align(axes, [label(name, units, r"\delta ") for name in names])
    handles: dict[str, Any] = {}
    for axis in axes.ravel():
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    if handles:
        corner = {"loc": "upper right", "bbox_to_anchor": (0.98, 0.94)}
        figure.legend(list(handles.values()), list(handles), **corner)
    if len(values) > 1 and n > 1:
        rows = ["standard deviation", f"{'':6}{'sampled':>12}{'linear':>12}"]
        for name, a, b in zip(names, np.diag(sampled), np.diag(linear), strict=True):
            rows.append(f"{name[:6]:6}{np.sqrt(max(a, 0)):12.3e}{np.sqrt(max(b, 0)):12.3e}")
        place = {"va": "top", "family": "monospace", "fontsize": 7.0}
        figure.text(0.39, 0.93, "\n".join(rows), **place)
    rate = f"{int(good.sum()):,} of {good.size:,} flights successful"
    figure.suptitle(f"Final state minus that of the undispersed flight; {rate}", fontsize=9.0)
    return figure


def align(axes: np.ndarray, texts: list[str]) -> None:
    """Columns share their abscissa, rows of pairs their ordinate; only the outer axes say which."""
    n = len(axes)
    for j in range(n):
        limits = [axes[i, j].get_xlim() for i in range(j, n)]
        low, high = min(a for a, _ in limits), max(b for _, b in limits)
        for i in range(j, n):
            axes[i, j].set_xlim(low, high)
            if i < n - 1:
                axes[i, j].tick_params(labelbottom=False)
                axes[i, j].xaxis.get_offset_text().set_visible(False)
        axes[n - 1, j].set_xlabel(texts[j])
    for i in range(1, n):
        limits = [axes[i, j].get_ylim() for j in range(i)]
        for j in range(i):
            axes[i, j].set_ylim(min(a for a, _ in limits), max(b for _, b in limits))
            if j > 0:
                axes[i, j].tick_params(labelleft=False)
                axes[i, j].yaxis.get_offset_text().set_visible(False)
        axes[i, 0].set_ylabel(texts[i])


def _histogram(axis: Axes, values: np.ndarray) -> None:
    if not len(values):
        return
    axis.hist(
        values, bins=60, color="#c8d8e8", edgecolor="#5a6a7a", linewidth=0.2, histtype="stepfilled"
    )
    for k, percent in enumerate((1.0, 50.0, 99.0)):
        at_percent = np.percentile(values, percent)
        axis.axvline(at_percent, label=f"{percent:g} %", linewidth=1.0, **line(k + 3))
    axis.grid(False)


def ellipse(axis: Axes, centre: np.ndarray, covariance: np.ndarray, **options: Any) -> None:
    """Three-sigma ellipse of a 2 x 2 covariance."""
    size, vectors = np.linalg.eigh(covariance)
    width, height = 6 * np.sqrt(np.maximum(size[::-1], 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    x, y = (float(c) for c in centre)
    text = f"3 sigma, {options.pop('label')}"
    axis.add_patch(
        Ellipse((x, y), width, height, angle=angle, fill=False, label=text, lw=1.3, **options)
    )
    axis.autoscale_view()


def at(extremal: Any, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States and controls of an Extremal at `t`, interpolated on the host in the Extremal's own
    piecewise polynomials: a figure should not cost a compilation."""
    breaks, reference, pieces = _pieces(extremal)
    n, m = extremal.problem.n, extremal.problem.m
    out = np.empty((len(t), n + m))
    segment = np.clip(np.searchsorted(breaks, t, side="right") - 1, 0, len(breaks) - 2)
    for s in np.unique(segment):
        here, (a, b) = segment == s, breaks[s : s + 2]
        tau = np.clip((2 * t[here] - a - b) / (b - a), -1.0, 1.0)
        out[here] = evaluation(reference, tau) @ pieces[s, :, : n + m]
    return out[:, :n], out[:, n:]


def _pieces(extremal: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Breaks, reference nodes, and (x, u, costate) at them, segment by segment, each segment with
    its own end: control and costate may jump."""
    reference = np.asarray(extremal.reference_nodes)
    values = np.concatenate([np.asarray(a) for a in (extremal.x, extremal.u, extremal.costate)], 1)
    degree = len(reference) - 1
    breaks = np.asarray(extremal.t)[::degree]
    index = np.arange(len(breaks) - 1)[:, None] * degree + np.arange(degree + 1)[None, :]
    pieces, n = values[index], extremal.problem.n
    if extremal.u_before is not None:
        pieces[:, -1, n:-n] = extremal.u_before
        pieces[:, -1, -n:] = extremal.costate_before
    return breaks, reference, pieces


@styled
def plot_tuning(tuned: Any, places: Callable[[Any], Mapping[str, Any]] | None = None) -> Figure:
    """A `jg.tune` run: loss and gradient over its steps, and the design before and after.

    **Arguments:** `tuned`: a Tuned. `places(design)`: name -> places on [0, 1], drawn as ticks;
    without it every leaf of the design is drawn over its index.
    """
    history, best = tuned.history, int(tuned.at)
    draw = _named_leaves if places is None else places
    before, after = draw(tuned.start), draw(tuned.design)
    counts = [k for k, v in history.items() if k.startswith("design:") and v.ndim == 1]
    figure = Figure(figsize=(WIDTH, 2.2 + 1.1 * len(after) + 1.6 * bool(counts)))
    heights = [2.2, *[1.6] * bool(counts), *[1.0] * len(after)]
    axes = list(figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0])
    _loss(axes[0], history, best)
    if counts:
        for i, name in enumerate(counts):
            word = name.removeprefix("design:")
            axes[1].plot(history[name], label=word, **line(i))
            axes[1].plot(best, history[name][best], "o", color=COLOURS[i % len(COLOURS)])
        axes[1].set_xlabel("step")
        axes[1].legend()
    for ax, name in zip(axes[1 + bool(counts) :], after, strict=True):
        rows = [np.ravel(before[name]), np.ravel(after[name])]
        if places is None:
            for i, (row, word) in enumerate(zip(rows, ("start", "tuned"), strict=True)):
                ax.plot(row, marker=MARKERS[i], label=word, **line(i))
            ax.legend()
            ax.set_title(name)
            continue
        for i, row in enumerate(rows):
            ax.vlines(row, 0.6 - i, 1.4 - i, color=COLOURS[i], linewidth=1.0)
        ax.set_yticks([1.0, 0.0], [f"start, {rows[0].size}", f"tuned, {rows[1].size}"])
        ax.grid(False)
        ax.set_xlim(-0.01, 1.01)
        ax.set_xlabel(f"{name}: place on the horizon")
    return figure


def _loss(ax: Axes, history: Mapping[str, Any], best: int) -> None:
    loss = history["loss"]
    if np.all(loss > 0) and loss.max() > 10 * loss.min():
        ax.set_yscale("log")
    ax.plot(loss, label="loss", **line(0))
    ax.plot(best, loss[best], "o", color=COLOURS[0])
    ax.set_xlabel("step")
    ax.set_ylabel("loss")
    beside = ax.twinx()
    beside.semilogy(np.maximum(history["gradient_norm"], 1e-300), label="gradient", **line(1))
    beside.set_ylabel("norm of the gradient")
    beside.grid(False)
    handles = [*ax.get_lines()[:1], *beside.get_lines()]
    ax.legend(handles, ["loss", "norm of the gradient"])
    ax.set_title("Tuning")


def _named_leaves(design: Any) -> dict[str, Any]:
    from jaxguide.tuning.designs import named

    return named(design)
