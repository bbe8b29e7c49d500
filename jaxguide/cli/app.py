"""What every command shares: its options, its outcome, and how it solves, saves and tells."""

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
    """What a command found: `data` for `--json`, `shown` for people."""

    data: dict[str, Any]
    shown: list[Any]
    ok: bool = True


def solved(name: str, watch: Any = None) -> tuple[Any, Any]:
    """A problem of the library and its extremal."""
    from jaxguide import problems as library

    problem = library.get(name)
    import jaxguide as jg

    with waiting(RichProgress(f"solve {name}")):
        return problem, jg.solve(problem, watch=watch)


def result_of(result: Any) -> dict[str, Any]:
    from jaxguide.types import RESULTS, succeeded

    message = RESULTS[result]
    return {"ok": succeeded(result), "message": message}


def folder(out: Path | None) -> Path | None:
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    return out


def save(figure: Any, out: Path, stem: str) -> str:
    from jaxguide import plotting

    return plotting.save(figure, out / f"{stem}.png")


def written(figures: list[str]) -> list[Text]:
    return [Text("written: " + ", ".join(figures))] if figures else []
