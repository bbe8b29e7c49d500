"""`jaxguide problems`, `solve`, `gains`, `fly`, `reproduce`: one problem at a time."""

import sys
from pathlib import Path
from typing import Any, Literal

from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app, folder, result_of, save_figure, solved, written
from jaxguide.host.progress import RichProgress, waiting


@app.command
def problems(*, common: Common = Common()) -> Outcome:
    """List the problems of the library."""
    from jaxguide import problems as library

    texts = {name: library.describe(name) for name in library.names()}
    table = Table("problem", "", box=None)
    for name, text in texts.items():
        table.add_row(name, Text(text))
    return Outcome({"problems": texts}, [table])


@app.command
def reproduce(name: str, *, out: Path | None = None, common: Common = Common()) -> Outcome:
    """Compute a published result and print it beside the published one.

    Exits with 1 if a row is out of its tolerance.

    Parameters
    ----------
    name
        Which result, such as `earth-mars`.
    out
        Folder for the figures.
    """
    from jaxguide import reproduce as library

    report = library.get(name).run(folder(out), RichProgress(f"reproduce {name}"))
    return Outcome(report.to_dict(), [report], report.passed)


@app.command
def solve(
    name: str, *, plot: bool = False, out: Path | None = None, common: Common = Common()
) -> Outcome:
    """Solve a problem of the library and certify the extremal.

    Exits with 1 if a row of the certificate fails.

    Parameters
    ----------
    name
        A problem, as `jaxguide problems` lists them.
    plot
        Write a figure of states, controls and costates.
    out
        Folder for the figure, which is then drawn; with --plot alone, the current folder.
    """
    from jaxguide import problems as library

    out = Path() if plot and out is None else out
    problem, extremal = solved(name, watch=lambda step: print(step, file=sys.stderr))
    known = library.reference(name)
    with waiting(RichProgress("certificate")):
        certificate = extremal.certificate
        table, rows = str(certificate), certificate.rows()
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_extremal

        figures = [save_figure(plot_extremal(extremal), out, f"{name}-extremal")]
    data = {
        "problem": name,
        "objective": extremal.objective,
        "known": known._asdict(),
        "final_time": extremal.final_time,
        "state_names": problem.state_names,
        "control_names": problem.control_names,
        "t": extremal.t,
        "x": extremal.x,
        "u": extremal.u,
        "costate": extremal.costate,
        "certificate": rows,
        "result": result_of(extremal.result),
        "figures": figures,
    }
    head = (
        f"objective   {float(extremal.objective):.12g}\n"
        f"known       {known.value:.12g} +- {known.uncertainty:.0e}  ({known.source})\n"
        f"final time  {float(extremal.final_time):.12g}"
    )
    ok = all(row["passed"] for row in rows)
    return Outcome(data, [Text(head), Text(table), *written(figures)], ok)


@app.command
def gains(
    name: str,
    *,
    method: Literal["segmented", "least_squares", "square"] = "segmented",
    nodes: int | None = None,
    count: int = 100,
    out: Path | None = None,
    common: Common = Common(),
) -> Outcome:
    """Neighbouring-optimal gains along the extremal of a problem.

    Exits with 1 if a gain is not resolved.

    Parameters
    ----------
    name
        A problem, as `jaxguide problems` lists them.
    method
        How the second variation is discretised.
    nodes
        Points of the discretisation; the method's own choice if absent.
    count
        Number of times, evenly over the horizon; the final time, where gains to a hard
        terminal constraint are infinite, is left out.
    out
        Folder for the figure.
    """
    if count < 1:
        raise ValueError(f"--count must be at least 1, got {count}.")
    problem, extremal = solved(name)
    import jax.numpy as jnp

    import jaxguide as jg

    times = jnp.linspace(extremal.t[0], extremal.final_time, count, endpoint=False)
    with waiting(RichProgress(f"gains {name}")):
        schedule = jg.gain_schedule(extremal, times, method=method, nodes=nodes)
        resolved = [bool(r) for r in schedule.resolved]
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_gains

        figures = [save_figure(plot_gains(schedule), out, f"{name}-gains")]
    data = {
        "problem": name,
        "method": method,
        "state_names": problem.state_names,
        "control_names": problem.control_names,
        "times": schedule.times,
        "K": schedule.K,
        "error": schedule.error,
        "resolved": resolved,
        "figures": figures,
    }
    table = _gain_table(problem, schedule, resolved)
    return Outcome(data, [table, *written(figures)], all(resolved))


def _gain_table(problem: Any, schedule: Any, resolved: list[bool]) -> Table:
    """A row for each time: the gains by name, their error, and whether they are resolved."""
    pairs = [(i, j) for i in range(schedule.K.shape[1]) for j in range(schedule.K.shape[2])]
    heads = [f"d{problem.control_names[i]}/d{problem.state_names[j]}" for i, j in pairs]
    table = Table("t", *heads, "error", "", box=None)
    for k, t in enumerate(schedule.times):
        numbers = [f"{float(schedule.K[k, i, j]):.9g}" for i, j in pairs]
        note = "" if resolved[k] else Text("not resolved", "bold red")
        table.add_row(f"{float(t):.6g}", *numbers, f"{float(schedule.error[k]):.1e}", note)
    return table


@app.command
def fly(name: str, *, out: Path | None = None, common: Common = Common()) -> Outcome:
    """Fly the closed loop of a named mission once.

    Parameters
    ----------
    name
        A problem with a mission, as `jaxguide problems` lists them.
    out
        Folder for the figure.
    """
    from jaxguide import problems as library

    problem = library.get(name)
    import jaxguide as jg

    with waiting(RichProgress(f"fly {name}")):
        flight = jg.simulate(library.mission(name))
        result = result_of(flight.result)
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_flight

        figures = [save_figure(plot_flight(flight, solved(name)[1]), out, f"{name}-flight")]
    data = {
        "problem": name,
        "state_names": problem.state_names,
        "control_names": problem.control_names,
        "t": flight.t,
        "x": flight.x,
        "u": flight.u,
        "final_state": flight.final_state,
        "final_time": flight.final_time,
        "result": result,
        "figures": figures,
    }
    table = Table("", "at the end", box=None)
    table.add_row("t", f"{float(flight.final_time):.12g}")
    for state, value in zip(problem.state_names, flight.final_state, strict=True):
        table.add_row(state, f"{float(value):.12g}")
    shown = [table, *([] if result["ok"] else [Text(result["message"])]), *written(figures)]
    return Outcome(data, shown, result["ok"])
