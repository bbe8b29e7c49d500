"""`jaxguide tune`: a named design, tuned by gradient and confirmed on fresh cases."""

from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app, folder, save_figure, written
from jaxguide.host.progress import RichProgress, waiting


@app.command
def tune(
    name: str,
    *,
    steps: int | None = None,
    cases: int | None = None,
    seed: int = 0,
    fresh: int = 10_000,
    out: Path | None = None,
    common: Common = Common(),
) -> Outcome:
    """Tune a design by gradient through nominal, gains and flights.

    The design found is confirmed with true integers on fresh cases. Exits with 1 if it is not
    better than the one it started from.

    Parameters
    ----------
    name
        A design: earth-mars, earth-mars-history, lunar-launch or moon-lander.
    steps
        Steps of the optimiser; the design's own number if absent.
    cases
        Flights behind each gradient; the design's own number if absent.
    seed
        Seed of these flights; the fresh ones have the next seed.
    fresh
        Flights that confirm the design.
    out
        Folder for the history, written every second of the run, and for the figure.
    """
    for option, value in (("--steps", steps), ("--cases", cases), ("--fresh", fresh)):
        if value is not None and value < 1:
            raise ValueError(f"{option} must be at least 1, got {value}.")
    from jaxguide import problems as library

    if name not in library.designs():
        library.design(name)  # raises an error that names the designs
    with waiting(RichProgress(f"design {name}")):
        ready = library.design(name) if steps is None else library.design(name, steps=steps)
    options = {"cases": cases, "seed": seed}
    runs = _tuned(ready, steps, folder(out), options)
    with waiting(RichProgress("confirm")):
        confirmed = runs[-1][0].confirm(runs[-1][1], fresh, seed + 1)
    figures = [] if out is None else _figures(name, runs, out)
    data = {
        "design": name,
        "about": ready.about,
        "cases": ready.cases if cases is None else cases,
        "seed": seed,
        "fresh": fresh,
        "runs": [_run_data(run) for _, run in runs],
        "confirmed": {key: list(pair) for key, pair in confirmed.rows.items()},
        "beside": {str(n): value for n, value in confirmed.beside.items()},
        "notes": list(confirmed.notes),
        "better": confirmed.better,
        "figures": figures,
    }
    head = [Text(f"{made.about}\n  {_in_words(run)}") for made, run in runs]
    table = Table("", "start", "tuned", box=None)
    for key, (before, after) in confirmed.rows.items():
        table.add_row(key, f"{before:.6g}", f"{after:.6g}")
    notes = map(Text, confirmed.notes)
    return Outcome(data, [*head, table, *notes, *written(figures)], confirmed.better)


def _tuned(
    ready: Any, steps: int | None, out: Path | None, options: dict[str, Any]
) -> list[tuple[Any, Any]]:
    """(design, run) of each run: of the design, and of the same with its count rounded if it has
    one."""
    meter = lambda what, count: RichProgress(f"{what} {ready.name}", total=count, unit="steps")
    tuned = ready.tune(out=out, progress=meter("tune", ready.steps), **options)
    if ready.rounded is None:
        return [(ready, tuned)]
    with waiting(RichProgress("round")):
        whole = ready.rounded(tuned)
    count = whole.steps if steps is None else min(steps, whole.steps)
    beside = None if out is None else out / "rounded"
    last = whole.tune(count, out=beside, progress=meter("tune rounded", count), **options)
    return [(ready, tuned), (whole, last)]


def _figures(name: str, runs: list[tuple[Any, Any]], out: Path) -> list[str]:
    from jaxguide.plotting import plot_tuning

    words = ("tuning", "rounded")
    return [
        save_figure(plot_tuning(run, made.places), out, f"{name}-{word}")
        for (made, run), word in zip(runs, words, strict=False)
    ]


def _run_data(run: Any) -> dict[str, Any]:
    names = ("loss", "at", "start", "design", "stopped", "message", "compile_s", "step_s")
    return {name: getattr(run, name) for name in names} | {
        "steps": len(run.history["loss"]),
        "history": run.history,
    }


def _in_words(run: Any) -> str:
    return (
        f"loss {float(run.history['loss'][0]):.6g} to {run.loss:.6g} at step {run.at}; "
        f"{run.message} {run.step_s:.2g} s a step, {run.compile_s:.0f} s to compile"
    )
