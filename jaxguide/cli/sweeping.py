"""`jaxguide sweep` and `sweep rerun`: many flights, and one of them again."""

from pathlib import Path
from typing import Any, Literal

from cyclopts import App
from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app, result_of, save, solved, written
from jaxguide.progress import RichProgress, waiting

sweeps = App(name="sweep")
app.command(sweeps)


@sweeps.default
def sweep(
    name: str,
    *,
    cases: int,
    seed: int,
    store: Path | None = None,
    resume: bool = False,
    scheduler: str | None = None,
    dtype: Literal["float64", "float32"] = "float64",
    keep: Literal["all", "summary"] = "all",
    out: Path | None = None,
    common: Common = Common(),
) -> Outcome:
    """Fly a named mission many times from dispersed starts and plants.

    Failed cases are counted with their reason; they do not fail the sweep.

    Parameters
    ----------
    name
        A problem with a mission, as `jaxguide problems` lists them.
    cases
        Number of flights.
    seed
        The same seed gives the same flights.
    store
        Zarr store for the results.
    resume
        Go on with what the store holds.
    scheduler
        Address of a Dask scheduler.
    dtype
        Precision of the flights; the nominal and its gains are always float64.
    keep
        "summary" keeps statistics and each case's result alone, for millions of cases.
    out
        Folder for the figure.
    """
    if cases < 1:
        raise ValueError(f"--cases must be at least 1, got {cases}.")
    if resume and store is None:
        raise ValueError("--resume needs the --store to go on with.")
    from jaxguide import problems as library

    with waiting(RichProgress(f"mission {name}")):
        mission, dispersions = library.mission(name), library.dispersions(name)
    import jaxguide as jg

    progress = RichProgress(f"sweep {name}", total=cases, unit="flights")
    options: dict[str, Any] = {"store": store, "scheduler": scheduler, "dtype": dtype}
    options |= {"keep": keep, "label": name, "resume": resume}
    dataset = jg.sweep(mission, dispersions, cases, seed, progress=progress, **options)
    figures = []
    if out is not None and keep == "all":
        from jaxguide.plotting import plot_sweep

        figures = [save(plot_sweep(dataset), out, f"{name}-sweep")]
    data = dict(dataset.attrs)
    data |= {"problem": name, "cases": cases, "seed": seed, "dtype": dtype, "figures": figures}
    table = Table("", "", box=None, show_header=False)
    for key, value in data.items():
        if key != "figures":
            table.add_row(key, Text(f"{value:.6g}" if isinstance(value, float) else str(value)))
    return Outcome(data, [table, *written(figures)])


@sweeps.command
def rerun(store: Path, case: int, *, out: Path | None = None, common: Common = Common()) -> Outcome:
    """Fly one case of a stored sweep again, with its history.

    Exits with 1 if its end is not the stored one to 1e-12 of its size (a summary keeps none).

    Parameters
    ----------
    store
        Zarr store of a sweep of a named mission.
    case
        Its number, from 0.
    out
        Folder for the figure.
    """
    from jaxguide import problems as library
    from jaxguide.montecarlo.store import stored

    told, of_case = stored(store, case)
    name = told["label"]
    with waiting(RichProgress(f"mission {name}")):
        mission, dispersions = library.mission(name), library.dispersions(name)
    import numpy as np

    import jaxguide as jg
    from jaxguide.montecarlo.sweep import cast

    flight = jg.rerun(cast(mission, told["dtype"]), dispersions, told["seed"], case)
    states = library.get(name).state_names
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_flight

        picture = plot_flight(flight, solved(name)[1])
        figures = [save(picture, out, f"{name}-case-{case}")]
    final = np.asarray(flight.final_state)
    was, same = of_case.get("final_state"), None
    if was is not None:
        rounding = 1e-12 if told["dtype"] == "float64" else 1e-4
        same = bool(np.all(np.abs(final - was) <= rounding * np.maximum(1.0, np.abs(was))))
    data = {
        "problem": name, "case": case, "seed": told["seed"], "t": flight.t, "x": flight.x,
        "u": flight.u, "final_state": final, "stored": was, "same": same, "figures": figures,
        "result": result_of(flight.result),
    }  # fmt: skip
    table = Table("", "flown again", "stored", box=None)
    for i, state in enumerate(states):
        old = "not kept" if was is None else f"{float(was[i]):.15g}"
        table.add_row(state, f"{float(final[i]):.15g}", old)
    return Outcome(data, [table, *written(figures)], same is not False)
