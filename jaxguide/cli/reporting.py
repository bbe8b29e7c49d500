"""Stored sweeps read: `jaxguide report`, `export`, `compare`."""

from pathlib import Path

from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app


@app.command
def report(store: Path, *, out: Path | None = None, common: Common = Common()) -> Outcome:
    """Write a stored sweep as one HTML file with its figures inside, readable without a network.

    Parameters
    ----------
    store
        Zarr store of a sweep that was flown to its end.
    out
        The HTML file (default: the store's name, with .html).
    """
    from jaxguide.report import write

    written = write(store, out)
    return Outcome({"store": str(store), "report": str(written)}, [Text(f"written: {written}")])


@app.command
def export(store: Path, out: Path, *, common: Common = Common()) -> Outcome:
    """Write the cases of a stored sweep in another format.

    Parameters
    ----------
    store
        Zarr store of a sweep.
    out
        The file: its ending, .csv, .json, .parquet or .nc, chooses the format.
    """
    from jaxguide.export import export as to_file

    written = to_file(store, out)
    return Outcome({"store": str(store), "export": str(written)}, [Text(f"written: {written}")])


@app.command
def compare(a: Path, b: Path, *, quantity: str = "miss", common: Common = Common()) -> Outcome:
    """Compare two stored sweeps with the same draws, case by case: b minus a.

    Parameters
    ----------
    a, b
        Zarr stores of sweeps with one seed, flown by different laws, say.
    quantity
        The quantity compared: "miss", "final_time", or a state at the end.
    """
    from jaxguide.sweeping.compare import compare as paired
    from jaxguide.sweeping.store import open_store

    data = paired(open_store(a), open_store(b), quantity)
    table = Table("", "", box=None, show_header=False)
    for key, value in data.items():
        text = f"{value:.6g}" if isinstance(value, float) else str(value)
        table.add_row(key.replace("_", " "), text)
    return Outcome(data, [table])
