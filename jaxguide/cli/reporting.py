"""`jaxguide report`: a stored sweep as one HTML file."""

from pathlib import Path

from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app


@app.command
def report(store: Path, *, out: Path | None = None, common: Common = Common()) -> Outcome:
    """Write a stored sweep as one HTML file with its figures inside, to be read without network.

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
