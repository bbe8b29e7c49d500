"""The figures of a sweep's report: each a Figure, or None if there is nothing to draw."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxguide.plotting import COLOURS, WIDTH, align, ellipse, label, line, symbol
from jaxguide.report.embed import INK
from jaxguide.sweeping.tally import edges_of_bins

SHOWN = 4000  # cases in a scatter; more only blacken it
_ABREAST = 3  # panels of a figure
_BLUE, _RED = COLOURS[1], COLOURS[2]
_BANDS = ((1, 99, 0.18), (5, 95, 0.28), (25, 75, 0.4))  # percentiles and opacity


def shown_cases(data: Any) -> dict[str, np.ndarray]:
    """The first successful cases of a Dataset that keeps them, read into memory."""
    if "final_state" not in data:
        return {}
    first = data.isel(case=slice(0, 2 * SHOWN))
    good = np.flatnonzero(first["result"].values == 0)[:SHOWN]
    return {
        str(name): first[name].values[good] for name in data.data_vars if "case" in data[name].dims
    }


def _panels(count: int, height: float, more: float, **options: Any) -> tuple[Figure, np.ndarray]:
    """`count` axes, `_ABREAST` of them in a row; `height` in of a row, `more` of the whole."""
    columns = min(count, _ABREAST)
    rows = -(-count // columns)
    figure = Figure(figsize=(1.15 * WIDTH, height * rows + more))
    axes = figure.subplots(rows, columns, squeeze=False, **options).ravel()
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes


def histograms(attrs: dict[str, Any], counts: np.ndarray) -> Figure | None:
    """Histogram of every quantity about the undispersed flight, over all successful cases.

    **Arguments:** `attrs`: of the Dataset; `counts` (k, BINS): by `total_histograms`.
    """
    names = attrs["quantities"]
    figure, axes = _panels(len(names), 1.9, 0.3)
    edges = edges_of_bins()
    for i, (name, axis) in enumerate(zip(names, axes, strict=False)):
        total = counts[i].sum()
        scale, centre = attrs["reference"]["scale"][i], attrs["reference"]["centre"][i]
        if not total:
            axis.text(0.5, 0.5, "no successful case", ha="center", transform=axis.transAxes)
            continue
        below = np.concatenate([[0], np.cumsum(counts[i])])
        at = lambda share, e=edges, b=below, t=total: float(np.interp(share * t, b, e))
        low, high = at(0.0005), at(0.9995)
        low = 0.0 if name == "miss" else low
        grid = np.linspace(low, max(high, low + 1e-12), 61)
        density = np.diff(np.interp(grid, edges, below)) / total * 100
        x = grid * scale
        axis.stairs(density, x, fill=True, color=_BLUE, alpha=0.35)
        axis.stairs(density, x, color=_BLUE, linewidth=0.8)
        for k, share in enumerate((0.01, 0.5, 0.99)):
            axis.axvline(at(share) * scale, label=f"{100 * share:g} %", lw=1.0, **line(2 + k))
        axis.set_xlabel(label(name, None, "" if name == "miss" else r"\delta "))
        axis.set_ylim(0, None)
        axis.locator_params(nbins=4)
        axis.grid(axis="x", visible=False)
        if abs(centre) > 0 and name != "miss":
            axis.set_title(f"undispersed: {centre:.6g}", fontsize=7.5, loc="right")
        if i % _ABREAST == 0:
            axis.set_ylabel("cases [%]")
    axes[0].legend(loc="best", fontsize=7)
    return figure


def corner(data: Any, cases: dict[str, np.ndarray]) -> Figure | None:
    """Final states in pairs, with three-sigma ellipses of the sampled and the linear covariance."""
    attrs = data.attrs
    names = [str(s) for s in data["state"].values][:7]
    n = len(names)
    if n < 2 or not attrs["percentiles"]:
        return None
    nominal = np.asarray(attrs["nominal_final_state"], float)[:n]
    mean = np.array([attrs["percentiles"][name]["mean"] for name in names]) - nominal
    sampled = np.asarray(attrs["sample_covariance"], float)
    linear = np.asarray(attrs["linear_covariance"], float)
    of = lambda matrix, i, j: matrix[np.ix_([j, i], [j, i])]
    pairs = lambda i, j: (mean[[j, i]], of(sampled, i, j), of(linear, i, j))
    names = [label(name, None, r"\delta ") for name in names]
    if not cases:
        return _ellipses_alone(names, pairs)
    values = cases["final_state"][:, :n].astype(float) - nominal[None]
    figure = Figure(figsize=(1.15 * WIDTH, 0.95 * WIDTH))
    axes = figure.subplots(n, n, squeeze=False)
    for i in range(n):
        for j in range(n):
            axis = axes[i, j]
            if j > i:
                axis.set_visible(False)
            elif j == i:
                axis.hist(values[:, i], bins=50, color=_BLUE, alpha=0.4, histtype="stepfilled")
                axis.hist(values[:, i], bins=50, color=_BLUE, lw=0.8, histtype="step")
                axis.yaxis.tick_right()
                axis.tick_params(labelright=False)
            else:
                _dots(axis, values[:, j], values[:, i])
                _ellipses(axis, *pairs(i, j))
            axis.locator_params(nbins=3)
    align(axes, names)
    handles = dict(zip(*reversed(axes[1, 0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="upper right", bbox_to_anchor=(0.98, 0.96))
    return figure


def _ellipses_alone(names: list[str], pairs: Any) -> Figure:
    """The pairs, of a store that keeps no cases."""
    both = [(i, j) for i in range(len(names)) for j in range(i)]
    figure, axes = _panels(len(both), 2.2, 0.4)
    for axis, (i, j) in zip(axes, both, strict=False):
        _ellipses(axis, *pairs(i, j))
        axis.set_xlabel(names[j])
        axis.set_ylabel(names[i])
        axis.locator_params(nbins=4)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def _ellipses(axis: Any, mean: np.ndarray, sampled: np.ndarray, linear: np.ndarray) -> None:
    ellipse(axis, mean, sampled, label="sampled", color=INK)
    ellipse(axis, np.zeros(2), linear, label="linear", color=_RED, linestyle=(0, (5, 1.5)))


def draws_against_miss(data: Any, cases: dict[str, np.ndarray], names: list[str]) -> Figure | None:
    """The miss against every drawn number, with its running mean and 95th percentile."""
    if not cases or "miss" not in cases or not len(cases["miss"]):
        return None
    if not names:
        return None
    paths = dict.fromkeys(name.partition("[")[0] for name in names)  # in the order of the names
    y = cases["miss"]
    x = np.concatenate([cases[f"draw:{path}"].reshape(len(y), -1) for path in paths], axis=1)
    figure, axes = _panels(x.shape[1], 1.9, 0.3, sharey=True)
    top = float(np.quantile(y, 0.998))
    for i, axis in enumerate(axes[: x.shape[1]]):
        _dots(axis, x[:, i], y)
        groups = [g for g in np.array_split(np.argsort(x[:, i]), 20) if len(g)]
        middle = [x[g, i].mean() for g in groups]
        axis.plot(middle, [y[g].mean() for g in groups], color=INK, label="mean")
        p95 = [np.quantile(y[g], 0.95) for g in groups]
        axis.plot(middle, p95, color=_RED, linestyle=(0, (5, 1.5)), label="95 %")
        axis.set_xlabel(names[i], fontsize=8)
        axis.set_ylim(0, top * 1.05 or 1.0)
        axis.locator_params(axis="x", nbins=4)
        if i % _ABREAST == 0:
            axis.set_ylabel("miss")
    axes[0].legend(loc="upper center", fontsize=7, ncols=2)
    return figure


def variance_shares(attrs: dict[str, Any]) -> Figure | None:
    """Share of each outcome's variance that each drawn number explains by itself: bars from the
    flights, marks from the linear covariance."""
    sampled, linear = attrs["importance"], attrs["linear_importance"]
    outcomes = [o for o in sampled if any(_finite(v[0]) for v in sampled[o].values())]
    if not outcomes:
        return None
    entries = list(sampled[outcomes[0]])
    groups = [g for g in next(iter(linear.values()), {}) if g not in entries]
    ticks = entries + groups
    figure, axes = _panels(len(outcomes), 0.22 * len(ticks) + 0.75, 0.35, sharey=True)
    at = np.arange(len(ticks))
    for outcome, axis in zip(outcomes, axes, strict=False):
        indices = [sampled[outcome].get(name, (None, None)) for name in ticks]
        share = np.array([100 * v if _finite(v) else np.nan for v, _ in indices])
        half = np.array([100 * h if _finite(h) else 0.0 for _, h in indices])
        axis.barh(at, share, 0.62, color=_BLUE, alpha=0.45, label="sampled")
        axis.errorbar(share, at, xerr=half, fmt="none", ecolor=INK, elinewidth=0.8, capsize=1.5)
        if outcome in linear:
            value = [linear[outcome].get(name) for name in ticks]
            value = [100 * v if _finite(v) else np.nan for v in value]
            axis.plot(value, at, "D", color=_RED, markersize=3.5, label="linear")
        axis.set_title(symbol(outcome))
        axis.set_yticks(at, ticks, fontsize=7.5)
        axis.set_xlim(min(0.0, float(np.nanmin(share - half))), 102)
        axis.grid(axis="y", visible=False)
    axes[0].invert_yaxis()
    for axis in axes[max(0, len(outcomes) - _ABREAST) : len(outcomes)]:
        axis.set_xlabel("share of variance [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def envelopes(data: Any) -> Figure | None:
    """Percentile bands over time of the full flights, and the failed ones among them."""
    if "history_x" not in data:
        return None
    t, x, u = (data[f"history_{name}"].values.astype(float) for name in ("t", "x", "u"))
    result = data["history_result"].values
    names = [str(s) for s in data["state"].values]
    controls = data.attrs["about"]["plant"]["controls"]
    grid = np.linspace(t.min(), t.max(), 240)
    good, bad = np.flatnonzero(result == 0), np.flatnonzero(result != 0)
    panels = [(name, t, x[:, :, i]) for i, name in enumerate(names)]
    panels += [(name, t[:, :-1], u[:, :, i]) for i, name in enumerate(controls)]
    figure = Figure(figsize=(1.15 * WIDTH, 1.5 * len(panels) + 0.3))
    axes = figure.subplots(len(panels), 2, squeeze=False, sharex=True)
    for (left, right), (name, times, values) in zip(axes, panels, strict=True):
        curves = np.stack([_on(grid, a, b) for a, b in zip(times, values, strict=True)])
        few = good if len(good) else np.arange(len(curves))
        with np.errstate(all="ignore"):
            some = np.isfinite(curves[few]).sum(axis=0) > 0.5 * len(few)
        middle = np.full(len(grid), np.nan)
        middle[some] = np.nanmedian(curves[few][:, some], axis=0)
        for axis, base in ((left, 0.0 * middle), (right, middle)):
            off = curves - base[None]
            for low, high, alpha in _BANDS:
                if len(good):
                    edges = np.nanpercentile(off[good][:, some], (low, high), axis=0)
                    text = f"{low} to {high} %"
                    axis.fill_between(
                        grid[some], *edges, color=_BLUE, alpha=alpha, lw=0, label=text
                    )
            for k, i in enumerate(bad[:20]):
                text = "failed" if k == 0 else None
                axis.plot(grid, off[i], color=_RED, lw=0.6, alpha=0.7, label=text)
        left.plot(grid, middle, color=INK, lw=0.9, label="median")
        left.set_ylabel(symbol(name))
        right.set_ylabel(symbol(name) + " less median")
    axes[0, 0].legend(loc="best", fontsize=6.5)
    for axis in axes[-1]:
        axis.set_xlabel("t")
    axes[0, 0].set_xlim(grid[0], grid[-1])
    return figure


def _on(grid: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A history interpolated on `grid`; NaN after its end, from which the last value is repeated if
    the law decides the end."""
    order = np.argsort(t, kind="stable")
    return np.where(grid <= t.max(), np.interp(grid, t[order], values[order]), np.nan)


def _dots(axis: Any, x: np.ndarray, y: np.ndarray) -> None:
    axis.plot(
        x, y, ".", color="#8a8f98", markersize=1.8, alpha=0.45, markeredgewidth=0, rasterized=True,
        zorder=1,
    )  # fmt: skip


def _finite(value: Any) -> bool:
    return value is not None and bool(np.isfinite(value))
