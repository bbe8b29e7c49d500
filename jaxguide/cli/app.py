"""Parts of every command: its options, its outcome, solving a named problem, saving figures."""

import dataclasses
from pathlib import Path
from typing import Any

from cyclopts import App, Parameter
from rich.text import Text

from jaxguide.host.progress import RichProgress, waiting

app = App(
    name="jaxguide",
    help="Optimal control, neighbouring-optimal gains and their flights.",
    default_parameter=Parameter(negative=""),  # no --no-json
)


@Parameter(name="*")
@dataclasses.dataclass(frozen=True)
class Common:
    """Options of every command."""

    json: bool = False
    "Print one JSON object on stdout, everything else on stderr."

    debug: bool = False
    "Show the traceback of an error."


@dataclasses.dataclass
class Outcome:
    """Outcome of a command: `data` for `--json`, `shown` for people (lines and tables of Rich), and
    whether the exit code is 0."""

    data: dict[str, Any]
    shown: list[Any]
    ok: bool = True


def solved(name: str, watch: Any = None) -> tuple[Any, Any]:
    """A problem of the library and its extremal; `watch`: as for `jg.solve`."""
    from jaxguide import problems as library

    problem = library.get(name)
    import jaxguide as jg

    with waiting(RichProgress(f"solve {name}")):
        return problem, jg.solve(problem, watch=watch)


def result_of(result: Any) -> dict[str, Any]:
    """A RESULTS as data: whether it is a success, and its message."""
    from jaxguide.types import RESULTS, succeeded

    message = RESULTS[result]
    return {"ok": succeeded(result), "message": message}


def folder(out: Path | None) -> Path | None:
    """`out`, made if it is a folder that is not there."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    return out


def save_figure(figure: Any, out: Path, stem: str) -> str:
    """Writes a figure as `stem`.png into the folder `out`; returns the path of the file."""
    from jaxguide import plotting

    return plotting.save(figure, out / f"{stem}.png")


def written(figures: list[str]) -> list[Text]:
    """A line that names the figures written; none without figures."""
    return [Text("written: " + ", ".join(figures))] if figures else []
