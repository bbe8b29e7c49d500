"""Figures of sweeps: corner plots, histograms, dispersion ellipses."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxguide.plotting.style import WIDTH, Units, label, line, styled


@styled
def plot_sweep(dataset: Any, units: Units = None) -> Figure:
    """Final states of a sweep, from that of the undispersed flight: histograms on the diagonal,
    pairs below it.

    Pairs show three-sigma ellipses of the sampled covariance and, dashed, of the linear one;
    histograms show the 1st, 50th and 99th percentiles. The title counts the successful cases.

    **Arguments:** `dataset`: of `jg.sweep` with `keep="all"`.
    """
    names = [str(s) for s in np.asarray(dataset["state"])]
    good = np.isfinite(np.asarray(dataset["final_state"])).all(axis=1)
    good &= np.asarray(dataset["result"]) == 0
    finals = np.asarray(dataset["final_state"], float)[good]
    attrs = dataset.attrs
    n = len(names)
    figure = Figure(figsize=(WIDTH, 0.86 * WIDTH))
    axes = figure.subplots(n, n, squeeze=False)
    # Final states scatter little about large values, so they are shown from the undispersed end.
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
    """Gives columns one abscissa and rows of pairs one ordinate; only the outer axes are labelled.

    **Arguments:** `axes` (n, n): of a corner plot; `texts`: labels of the n quantities.
    """
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
    """Draws the three-sigma ellipse of a 2 x 2 `covariance` about `centre`.

    **Arguments:** `options`: of `matplotlib.patches.Ellipse`; `label` among them is required.
    """
    size, vectors = np.linalg.eigh(covariance)
    width, height = 6 * np.sqrt(np.maximum(size[::-1], 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    x, y = (float(c) for c in centre)
    text = f"3 sigma, {options.pop('label')}"
    axis.add_patch(
        Ellipse((x, y), width, height, angle=angle, fill=False, label=text, lw=1.3, **options)
    )
    axis.autoscale_view()
