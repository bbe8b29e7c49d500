"""`jaxguide sweep`, many flights, and `sweep rerun`, one of them again."""

import contextlib
from pathlib import Path
from typing import Any, Literal

from cyclopts import App
from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app, result_of, save_figure, solved, written
from jaxguide.host.progress import RichProgress, waiting

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
    dispersions: Path | None = None,
    sampling: Literal["random", "latin_hypercube", "sobol"] = "random",
    stop: str | None = None,
    keep: Literal["all", "summary"] = "all",
    histories: int = 0,
    failures: int = 0,
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
        Continue the sweep that the store holds.
    scheduler
        Address of a Dask scheduler.
    dtype
        Precision of the flights; the nominal and its gains are always float64.
    dispersions
        A TOML or YAML file of dispersions, in place of the problem's own.
    sampling
        How cases lie over their distributions: at random, in layers, or evenly (Sobol).
    stop
        Stop early when bounds are narrow: "success:0.001" (width of the success rate's bounds) or
        "miss:99:1e-6" (of the 99th percentile of the miss, or of a state).
    keep
        "summary" keeps only statistics and the result of each case, for millions of cases.
    histories
        How many cases, the first, are kept with their whole histories.
    failures
        How many failed cases, the first, are kept with their whole histories.
    out
        Folder for the figure.
    """
    if cases < 1:
        raise ValueError(f"--cases must be at least 1, got {cases}.")
    if resume and store is None:
        raise ValueError("--resume needs the --store to go on with.")
    from jaxguide import problems as library

    rule = _rule(stop)
    spread = library.dispersions(name) if dispersions is None else _read(dispersions)
    with waiting(RichProgress(f"mission {name}")):
        mission = library.mission(name)
    import jaxguide as jg

    progress = RichProgress(f"sweep {name}", total=cases, unit="flights")
    options: dict[str, Any] = {"store": store, "scheduler": scheduler, "dtype": dtype}
    options |= {"keep": keep, "label": name, "resume": resume, "sampling": sampling, "stop": rule}
    options |= {"histories": histories, "failures": failures}
    dataset = jg.sweep(mission, spread, cases, seed, progress=progress, **options)
    figures = []
    if out is not None and keep == "all":
        from jaxguide.plotting import plot_sweep

        figures = [save_figure(plot_sweep(dataset), out, f"{name}-sweep")]
    data = dict(dataset.attrs)
    data |= {"problem": name, "cases": cases, "seed": seed, "dtype": dtype, "figures": figures}
    return Outcome(data, [_shown(data), *written(figures)])


def _rule(stop: str | None) -> Any:
    from jaxguide.sweeping.stopping import rule

    return None if stop is None else rule(stop)


def _read(dispersions: Path) -> Any:
    from jaxguide.sweeping.written import dispersions_from

    return dispersions_from(dispersions)


def _shown(data: dict[str, Any]) -> Table:
    """A table of the numbers of a sweep by name; one line for each entry of a nested dictionary,
    and one for the worst cases."""
    table = Table("", "", box=None, show_header=False)
    short = lambda v: f"{v:.6g}" if isinstance(v, float) else str(v)
    for key, value in data.items():
        if key in ("figures", "about", "reference", "quantities"):
            continue
        if isinstance(value, dict) and any(isinstance(v, dict) for v in value.values()):
            for name, inner in value.items():
                table.add_row(f"{key}: {name}", Text(str(inner)))
        elif key == "worst":
            worst = ", ".join(f"{w['case']} ({w['measure']:.4g})" for w in value[:5])
            table.add_row("worst cases", Text(worst))
        else:
            table.add_row(key, Text(short(value)))
    return table


def options_of_xla(command: Any, arguments: dict[str, Any]) -> None:
    """Sets XLA's options before JAX starts: for a sweep, those that make flights fast; for a case
    flown again, those of its store, since with others the last digits of nominal and gains differ.
    """
    from jaxguide.host import flags

    if command is sweep:
        flags.set_for_flights()
    elif command is rerun:
        from jaxguide.sweeping.store import attributes_of

        with contextlib.suppress(ValueError):  # the command itself raises it again
            flags.take(attributes_of(arguments["store"])["sweep"].get("xla", ""))


@sweeps.command
def rerun(store: Path, case: int, *, out: Path | None = None, common: Common = Common()) -> Outcome:
    """Fly one case of a stored sweep again, with its history.

    Exits with 1 if its end is not the stored one to 1e-12 of its size (a summary keeps none), or if
    the mission is no longer that of the store.

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
    from jaxguide.sweeping.store import stored

    manifest, of_case = stored(store, case)
    name = manifest["label"]
    with waiting(RichProgress(f"mission {name}")):
        mission = library.mission(name)
    import jaxguide as jg
    from jaxguide.sweeping.sweep import again, cast

    mission = cast(mission, manifest["dtype"])
    dispersions, note = again(manifest, mission, library.dispersions(name), store)
    sampled = {"sampling": manifest["sampling"], "cases": manifest["cases"]}
    flight = jg.rerun(mission, dispersions, manifest["seed"], case, **sampled)
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_flight

        picture = plot_flight(flight, solved(name)[1])
        figures = [save_figure(picture, out, f"{name}-case-{case}")]
    was = of_case.get("final_state")
    same = None if was is None else _same_end(flight, was, manifest["dtype"])
    data = {
        "problem": name, "case": case, "seed": manifest["seed"], "t": flight.t, "x": flight.x,
        "u": flight.u, "final_state": flight.final_state, "stored": was, "same": same,
        "figures": figures, "result": result_of(flight.result), "note": note,
    }  # fmt: skip
    table = Table("", "flown again", "stored", box=None)
    for i, state in enumerate(library.get(name).state_names):
        old = "not kept" if was is None else f"{float(was[i]):.15g}"
        table.add_row(state, f"{float(flight.final_state[i]):.15g}", old)
    notes = [Text(note)] if note else []
    return Outcome(data, [table, *notes, *written(figures)], same is not False)


# How well a flight alone agrees with the same one in a tile, of its size or of 1: programs round
# differently (by experiment).
_ROUNDING = {"float64": 1e-12, "float32": 1e-4}


def _same_end(flight: Any, was: Any, dtype: str) -> bool:
    """Whether the flight ends at the stored state `was`, up to rounding."""
    import numpy as np

    off = np.abs(np.asarray(flight.final_state) - was)
    return bool(np.all(off <= _ROUNDING[dtype] * np.maximum(1.0, np.abs(was))))
