"""`jaxguide tune`: a named design, tuned by gradient and confirmed on fresh cases."""

from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app, folder, save, written
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
        Of these flights; the fresh ones have the next.
    fresh
        Flights that confirm the design.
    out
        Folder for the history, kept up to date as the run goes, and for the figure.
    """
    for option, value in (("--steps", steps), ("--cases", cases), ("--fresh", fresh)):
        if value is not None and value < 1:
            raise ValueError(f"{option} must be at least 1, got {value}.")
    from jaxguide import problems as library

    if name not in library.designs():
        library.design(name)  # says which there are
    with waiting(RichProgress(f"design {name}")):
        ready = library.design(name) if steps is None else library.design(name, steps=steps)
    watch = lambda what, count: RichProgress(f"{what} {name}", total=count, unit="steps")
    options = {"cases": cases, "seed": seed}
    tuned = ready.tune(out=folder(out), progress=watch("tune", ready.steps), **options)
    runs = [(ready, tuned)]
    if ready.rounded is not None:
        with waiting(RichProgress("round")):
            whole = ready.rounded(tuned)
        count = whole.steps if steps is None else min(steps, whole.steps)
        beside = None if out is None else out / "rounded"
        last = whole.tune(count, out=beside, progress=watch("tune rounded", count), **options)
        runs.append((whole, last))
    with waiting(RichProgress("confirm")):
        confirmed = runs[-1][0].confirm(runs[-1][1], fresh, seed + 1)
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_tuning

        for (made, run), word in zip(runs, ("tuning", "rounded"), strict=False):
            figures.append(save(plot_tuning(run, made.places), out, f"{name}-{word}"))
    data = {
        "design": name,
        "about": ready.about,
        "cases": ready.cases if cases is None else cases,
        "seed": seed,
        "fresh": fresh,
        "runs": [_told(run) for _, run in runs],
        "confirmed": {key: list(pair) for key, pair in confirmed.rows.items()},
        "beside": {str(n): value for n, value in confirmed.beside.items()},
        "notes": list(confirmed.notes),
        "better": confirmed.better,
        "figures": figures,
    }
    head = [f"{made.about}\n  {_in_words(run)}" for made, run in runs]
    table = Table("", "start", "tuned", box=None)
    for key, (before, after) in confirmed.rows.items():
        table.add_row(key, f"{before:.6g}", f"{after:.6g}")
    notes = [Text(text) for text in (*head, *confirmed.notes)]
    return Outcome(
        data, [*notes[: len(head)], table, *notes[len(head) :], *written(figures)], confirmed.better
    )


def _told(run: Any) -> dict[str, Any]:
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
