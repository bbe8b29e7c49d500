"""Figures of extremals, gains and flights."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxguide.plotting.style import (
    COLOURS,
    MARKERS,
    Units,
    costate_symbol,
    label,
    line,
    names_of,
    panel_grid,
    styled,
    symbol,
    time_axis,
)
from jaxguide.spectral.grids import evaluation


@styled
def plot_extremal(extremal: Any, units: Units = None) -> Figure:
    """Controls, states and costates of an Extremal against time (2002 paper, figure 2, and the
    costates)."""
    states, controls = names_of(extremal.problem)
    breaks, reference, pieces = _pieces(extremal)
    # Points between the nodes too: on a refined mesh nodes may lie far apart. 24 a segment, by eye.
    tau = np.linspace(-1.0, 1.0, 24)
    t = ((breaks[1:] + breaks[:-1])[:, None] + np.diff(breaks)[:, None] * tau).reshape(-1) / 2
    fine = np.concatenate(evaluation(reference, tau) @ pieces)
    n = len(states)
    panels = (
        ("control", fine[:, n:-n], controls, ""),
        ("state", fine[:, :n], states, ""),
        ("costate", fine[:, -n:], states, r"\lambda"),
    )
    figure, axes = panel_grid(3, 1, 2.1, sharex=True)
    for axis, (what, values, names, prefix) in zip(axes[:, 0], panels, strict=True):
        for i, name in enumerate(names):
            text = symbol(name) if not prefix else costate_symbol(name)
            unit = "" if prefix else (units or {}).get(name, "")
            axis.plot(t, values[:, i], label=f"{text} [{unit}]" if unit else text, **line(i))
        axis.set_ylabel(label(names[0], units) if len(names) == 1 and not prefix else what)
        if len(names) > 1 or prefix:
            axis.legend(loc="best")
    axes[0, 0].set_xlim(t[0], t[-1])
    time_axis(axes, units)
    return figure


@styled
def plot_gains(schedule: Any, units: Units = None) -> Figure:
    """Gains of a GainSchedule against time, on a symmetric logarithmic scale, and the estimate of
    their error below; gains that are not resolved are marked."""
    states, controls = names_of(schedule.extremal.problem)
    t, K = np.asarray(schedule.times), np.asarray(schedule.K)
    figure, axes = panel_grid(len(controls) + 1, 1, 2.3, sharex=True)
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
    time_axis(axes, units)
    return figure


@styled
def plot_flight(flight: Any, extremal: Any, units: Units = None) -> Figure:
    """States and controls of one Flight and of its nominal (left), and the difference (right; of
    controls, the command's deviation)."""
    states, controls = names_of(extremal.problem)
    t, x = np.asarray(flight.t), np.asarray(flight.x)
    x_nominal, u_nominal = at(extremal, t)
    u, du = np.asarray(flight.u), np.asarray(flight.commands)
    figure, axes = panel_grid(len(states) + len(controls), 2, 1.45, sharex=True)
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
    time_axis(axes, units)
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

    **Arguments:** `flights`: a Flight with a leading case axis; `names`: of states (their deviation
    is shown) or controls (the commanded feedback), one panel each; `labels`: one for each case.

    **Raises:** `ValueError` for a name that is neither.
    """
    states, controls = names_of(extremal.problem)
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
    states, at the same times, of the extremals from the perturbed starts; `names`: of the states
    shown, one panel each, among `state_names`; `labels`: one for each case.

    **Raises:** `ValueError` for a name that is not a state's.
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
    """One panel for each of `panels`: (times, values by case, label); all have the same cases."""
    cases = len(panels[0][1])
    labels = [f"case {k + 1}" for k in range(cases)] if labels is None else labels
    figure, axes = panel_grid(len(panels), 1, 3.4 if len(panels) == 1 else 2.2, sharex=True)
    for axis, (t, values, text) in zip(axes[:, 0], panels, strict=True):
        axis.axhline(0.0, color="#808080", linewidth=0.6)
        for k, (row, text_k) in enumerate(zip(values, labels, strict=True)):
            axis.plot(t, row, label=text_k, **line(k))
        axis.set_xlim(t[0], t[-1])
        axis.set_ylabel(text)
    time_axis(axes, units)
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

    **Arguments:** `errors`: (numbers of points, errors) by title of the panel, then by method;
    `abscissa`, `ordinate`: labels.
    """
    figure, axes = panel_grid(1, len(errors), 3.0, sharey=True)
    for axis, (title, methods) in zip(axes[0], errors.items(), strict=True):
        for k, (method, (points, values)) in enumerate(methods.items()):
            values = np.maximum(np.asarray(values, float), 1e-17)  # an error of 0 on a log scale
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


def at(extremal: Any, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (T, n) and controls (T, m) of an Extremal at the times `t` (T,).

    Interpolated on the host in the Extremal's own piecewise polynomials, since a figure should not
    cost a compilation.
    """
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
    """Breaks, reference nodes on [-1, 1], and (x, u, costate) at the nodes of every segment. Each
    segment has its own values at its end, as control and costate may jump there."""
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
