"""Figures of tuning: the loss against steps, and the design before and after."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxguide.plotting.style import COLOURS, MARKERS, WIDTH, line, styled


@styled
def plot_tuning(tuned: Any, places: Callable[[Any], Mapping[str, Any]] | None = None) -> Figure:
    """A run of `jg.tune`: loss and norm of the gradient against steps, and the design before and
    after.

    **Arguments:** `tuned`: the Tuned that `jg.tune` returns; `places`: from a design to places on
    [0, 1] by name, drawn as ticks. Without it every leaf of the design is drawn over its index.
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
    from jaxguide.tuning.variables import named

    return named(design)
