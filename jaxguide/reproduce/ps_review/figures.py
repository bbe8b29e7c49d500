"""Figures 4, 5, 7, 8 and 9 of the review, its figure 6 in numbers, and rates of convergence."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxguide import plotting as plot
from jaxguide.reproduce.ps_review import covectors, gaussian, rates, uniform, weighted
from jaxguide.reproduce.ps_review.published import cost_rate, state_rate
from jaxguide.spectral.grids import evaluation


def write_figures(out: Path) -> list[str]:
    """Writes the figures to the folder `out` and returns their paths."""
    figures = {
        "fig4-lagrange": interpolant(False),
        "fig5-weighted": interpolant(True),
        "fig6-covectors": diagram(),
        "fig7-uniform-10": uniform_control(10),
        "fig8-uniform-12": uniform_control(12),
        "fig9-gaussian": gaussian_controls(),
        "rates": rate_plot(),
    }
    return [plot.save(figures[name], out / f"ps-review-{name}.png") for name in figures]


def axes(rows: int, columns: int, height: float, width: float = 0.72) -> Any:
    """A figure `height` inches high and `width` of a page wide, and its axes by row and column."""
    figure = Figure(figsize=(plot.WIDTH * width, height))
    return figure, figure.subplots(rows, columns, squeeze=False)


@plot.styled
def interpolant(with_weight: bool) -> Any:
    """Review, figure 4: phi_2 on an arbitrary grid; with a weight, figure 5: W/W_2 phi_2."""
    figure, ((axis,),) = axes(1, 1, 2.6)
    x, j = weighted.ARBITRARY, weighted.CHOSEN
    t = np.linspace(-1, 1, 401)
    phi = weighted.basis(t, False)[:, j]
    if with_weight:
        y = weighted.basis(t, True)[:, j]
        axis.plot(t, y, label=r"$(1 - t)\,\phi_2(t) / (1 - t_2)$", **plot.line(0))
        axis.plot(t, phi, label=r"$\phi_2(t)$", **plot.line(2))
    else:
        axis.plot(t, phi, label=r"$\phi_2(t)$", **plot.line(0))
    values = (np.arange(len(x)) == j).astype(float)
    axis.plot(x, values, "o", color=plot.COLOURS[1], label=r"$\delta_{2k}$ at the nodes $t_k$")
    axis.set_xlim(-1, 1)
    axis.set_xlabel("t")
    axis.legend(loc="best")
    return figure


@plot.styled
def uniform_control(points: int) -> Any:
    """Review, figures 7 and 8: E1 on a uniform grid; where it is unbounded, with u <= 10."""
    figure, ((axis,),) = axes(1, 1, 2.6)
    found = uniform.solve_e1(points)
    t, fine = found.x + 1, np.linspace(0, 2, 401)
    u, text = found.u, "nodes"
    if u is None:
        u, text = uniform.program(found.x, 10.0).x[points:], r"nodes, with $u \leq 10$ imposed"
    curve = evaluation(found.x, fine - 1) @ u
    axis.plot(fine, curve, label="interpolant", **plot.line(1))
    axis.plot(fine, np.full_like(fine, -1.0), label="optimal, $u = -1$", **plot.line(0))
    axis.plot(t, u, "o", color=plot.COLOURS[2], label=text)
    if found.unbounded:
        axis.set_title(f"{points} points: unbounded below, so the bound decides")
        axis.set_yscale("symlog", linthresh=10)
    else:
        axis.set_ylim(-2, 0)
        axis.set_title(f"{points} points")
    axis.set_xlabel("t")
    axis.set_ylabel("u")
    axis.legend(loc="best")
    return figure


@plot.styled
def gaussian_controls() -> Any:
    """Review, figure 9: E2 on three grids of 10 points, and with the ends extrapolated."""
    figure, (row,) = axes(1, 3, 2.5, 1.15)
    for axis, family, title in zip(
        row, ("lg", "lgr-left", "lgl"), ("Gauss", "Gauss-Radau", "Gauss-Lobatto"), strict=True
    ):
        found = gaussian.solve_e2(family, 10)
        axis.plot([0, 1], [1, 1], label="optimal", **plot.line(0))
        axis.plot(found.t, found.u, "o:", color=plot.COLOURS[2], label="ends at nodes")
        if family != "lgl":
            other = gaussian.solve_e2(family, 10, extrapolated=True)
            axis.plot(other.t, other.u, "s", mfc="none", color=plot.COLOURS[1],
                      label="ends extrapolated")  # fmt: skip
        axis.set_title(f"{title}: error {found.error:.1g}")
        axis.set_xlabel("t")
        axis.set_ylim(-0.1, 3.2)
        axis.legend(loc="upper center")
    row[0].set_ylabel("u")
    return figure


@plot.styled
def diagram() -> Any:
    """Review, figure 6 in numbers: errors of the costate both ways around the diagram."""
    figure, (row,) = axes(1, 3, 2.6, 1.15)
    sizes = np.arange(5, 31)
    for axis, (family, title) in zip(
        row, (("lgl", "LGL"), ("lgr-right", "LGR"), ("lg", "LG")), strict=True
    ):
        found = [covectors.errors(family, int(n)) for n in sizes]
        shown = (("raw", "multipliers / weights"), ("closed", "the same, closed"),
                 ("dual", "dualised first"), ("gap", "between"))  # fmt: skip
        for i, (name, text) in enumerate(shown):
            if name == "closed" and family != "lgl":
                continue
            values = np.maximum([getattr(e, name) for e in found], 1e-17)
            axis.semilogy(sizes, values, label=text, **plot.line(i))
        axis.set_title(title)
        axis.set_xlabel("points")
        axis.set_ylim(1e-17, 1e6)
        axis.legend(loc="upper right", fontsize=7)
    row[0].set_ylabel("relative error of the costate")
    return figure


@plot.styled
def rate_plot() -> Any:
    """Errors against the number of points, and the slopes that the theorems promise."""
    figure, ((left, right),) = axes(1, 2, 2.8, 1.0)
    sizes = np.array(rates.SIZES)
    for i, m in enumerate((2, 3, 4, None)):
        feasible = [rates.feasible(n, m)[1] for n in rates.SIZES]
        cost = [rates.optimal(n, m)[0] for n in rates.SIZES]
        name = "smooth" if m is None else f"m = {m}"
        for axis, values, bound in ((left, feasible, state_rate), (right, cost, cost_rate)):
            kind = {"color": plot.COLOURS[i], "marker": plot.MARKERS[i], "linestyle": "-"}
            axis.loglog(sizes, np.maximum(values, 1e-17), label=name, **kind)
            if m is not None:
                promise = values[0] * ((sizes - 2) / (sizes[0] - 2)) ** bound(m)
                axis.loglog(sizes, promise, ":", color=plot.COLOURS[i])
    left.set_title("Theorem 2: feasible state")
    right.set_title("Optimal cost")
    for axis, height in ((left, 0.33), (right, 0.43)):  # between the lines
        axis.set_xlabel("points")
        place = {"loc": "center right", "bbox_to_anchor": (1.0, height)}
        axis.legend(title="dotted: promised", title_fontsize=7, **place)
    left.set_ylabel("error")
    return figure
