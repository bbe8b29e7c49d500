"""`jaxguide tune`: a named design, tuned by gradient and confirmed on fresh cases."""

from pathlib import Path

from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app, folder, save, written
from jaxguide.progress import RichProgress, waiting


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
    progress = RichProgress(f"tune {name}", total=ready.steps, unit="steps")
    tuned = ready.tune(cases=cases, seed=seed, out=folder(out), progress=progress)
    with waiting(RichProgress("confirm")):
        confirmed = ready.confirm(tuned, fresh, seed + 1)
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_tuning

        figures = [save(plot_tuning(tuned, ready.places), out, f"{name}-tuning")]
    data = {
        "design": name,
        "about": ready.about,
        "steps": len(tuned.history["loss"]),
        "cases": ready.cases if cases is None else cases,
        "seed": seed,
        "fresh": fresh,
        "loss": tuned.loss,
        "start": tuned.start,
        "tuned": tuned.design,
        "stopped": tuned.stopped,
        "message": tuned.message,
        "history": tuned.history,
        "compile_s": tuned.compile_s,
        "step_s": tuned.step_s,
        "confirmed": {key: list(pair) for key, pair in confirmed.rows.items()},
        "beside": {str(n): value for n, value in confirmed.beside.items()},
        "notes": list(confirmed.notes),
        "better": confirmed.better,
        "figures": figures,
    }
    head = (
        f"{ready.about}\nloss {float(tuned.history['loss'][0]):.6g} to {tuned.loss:.6g} at step "
        f"{tuned.at}; {tuned.message} {tuned.step_s:.2g} s a step, {tuned.compile_s:.0f} s to "
        "compile"
    )
    table = Table("", "start", "tuned", box=None)
    for key, (before, after) in confirmed.rows.items():
        table.add_row(key, f"{before:.6g}", f"{after:.6g}")
    shown = [Text(head), table, *(Text(note) for note in confirmed.notes), *written(figures)]
    return Outcome(data, shown, confirmed.better)
