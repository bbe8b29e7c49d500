"""The command line. Heavy imports wait inside the commands, so that `--help` is quick.

Each command returns an `Outcome`; `main` alone prints, reports errors and sets the exit code:
0 done, 1 failed or out of tolerance, 2 wrong usage.
"""

import contextlib
import dataclasses
import gc
import json
import os
import sys
from pathlib import Path
from typing import Any, Literal

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxguide.progress import RichProgress, waiting

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


def main(argv: list[str] | None = None) -> None:
    """Entry point."""
    code = run(sys.argv[1:] if argv is None else argv)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # taking XLA's programs down one by one would take a second


def run(argv: list[str]) -> int:
    """Runs one command line and returns its exit code."""
    try:
        command, bound, _ = app.parse_args(argv, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        return _fail(error, 2)
    common = bound.arguments.get("common", Common())
    if command not in COMMANDS:  # --help, --version
        command(*bound.args, **bound.kwargs)
        return 0
    configure()
    stdout = sys.stdout
    try:
        # With --json nothing else may reach stdout, not even a library's print.
        with contextlib.redirect_stdout(sys.stderr if common.json else stdout):
            outcome = command(*bound.args, **bound.kwargs)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    # The library's own complaints (UnknownName is a ValueError, Equinox's and XLA's errors are
    # RuntimeErrors), unwritable folders, missing extras. Anything else is a bug: its traceback
    # is wanted.
    except (ValueError, RuntimeError, OSError, ImportError) as error:
        if common.debug:
            raise
        if common.json:
            _print_json({"error": str(error)})
        return _fail(error, 1)
    if common.json:
        _print_json(outcome.data)
    else:
        console = Console()
        if not console.is_terminal:
            console.width = max(console.width, 120)  # a file need not be 80 columns wide
        console.print(*outcome.shown, sep="\n")
    return 0 if outcome.ok else 1


def configure() -> None:
    """float64, and a compilation cache that lasts, for this process.

    Called before JAX and Equinox are imported: both read the environment as they are.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # cache hits on CPU are noisy
    # Source lines in compiled programs serve debuggers and take a tenth of a short run.
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
    gc.set_threshold(200_000, 20, 20)  # tracing makes objects by the million, few of them garbage
    # A computation that holds an `eqx.error_if` is a host callback, which is never cached. The
    # library reports failures as values, so none is needed.
    os.environ.setdefault("EQX_ON_ERROR", "nan")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # else idle pools spin beside XLA
    import jax

    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "jaxguide"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@app.command
def problems(*, common: Common = Common()) -> Outcome:
    """List the problems of the library."""
    from jaxguide import problems as library

    described = {name: library.describe(name) for name in library.names()}
    table = Table("problem", "", box=None)
    for name, text in described.items():
        table.add_row(name, Text(text))
    return Outcome({"problems": described}, [table])


@app.command
def reproduce(name: str, *, out: Path | None = None, common: Common = Common()) -> Outcome:
    """Compute a published result and print it beside the printed one.

    Exits with 1 if a row is out of its tolerance.

    Parameters
    ----------
    name
        Which result, such as `earth-mars`.
    out
        Folder for the figures.
    """
    from jaxguide import reproduce as library

    report = library.get(name).run(_folder(out), RichProgress(f"reproduce {name}"))
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
        Folder for the figure, which it asks for; with --plot alone, the current one.
    """
    from jaxguide import problems as library

    out = Path() if plot and out is None else out
    problem, extremal = _solved(name, watch=lambda step: print(step, file=sys.stderr))
    known = library.reference(name)
    with waiting(RichProgress("certificate")):
        certificate = extremal.certificate
        table, rows = str(certificate), certificate.rows()
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_extremal

        figures = [_save(plot_extremal(extremal), out, f"{name}-extremal")]
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
        "result": _result(extremal.result),
        "figures": figures,
    }
    head = (
        f"objective   {float(extremal.objective):.12g}\n"
        f"known       {known.value:.12g} +- {known.uncertainty:.0e}  ({known.source})\n"
        f"final time  {float(extremal.final_time):.12g}"
    )
    ok = all(row["passed"] for row in rows)
    return Outcome(data, [Text(head), Text(table), *_written(figures)], ok)


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
    problem, extremal = _solved(name)
    import jax.numpy as jnp

    import jaxguide as jg

    times = jnp.linspace(extremal.t[0], extremal.final_time, count, endpoint=False)
    with waiting(RichProgress(f"gains {name}")):
        schedule = jg.gain_schedule(extremal, times, method=method, nodes=nodes)
        resolved = [bool(r) for r in schedule.resolved]
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_gains

        figures = [_save(plot_gains(schedule), out, f"{name}-gains")]
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
    pairs = [(i, j) for i in range(schedule.K.shape[1]) for j in range(schedule.K.shape[2])]
    heads = [f"d{problem.control_names[i]}/d{problem.state_names[j]}" for i, j in pairs]
    table = Table("t", *heads, "error", "", box=None)
    for k, t in enumerate(schedule.times):
        numbers = [f"{float(schedule.K[k, i, j]):.9g}" for i, j in pairs]
        note = "" if resolved[k] else Text("not resolved", "bold red")
        table.add_row(f"{float(t):.6g}", *numbers, f"{float(schedule.error[k]):.1e}", note)
    return Outcome(data, [table, *_written(figures)], all(resolved))


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
        result = _result(flight.result)
    figures = []
    if out is not None:
        from jaxguide.plotting import plot_flight

        figures = [_save(plot_flight(flight, _solved(name)[1]), out, f"{name}-flight")]
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
    shown = [table, *([] if result["ok"] else [Text(result["message"])]), *_written(figures)]
    return Outcome(data, shown, result["ok"])


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

        figures = [_save(plot_sweep(dataset), out, f"{name}-sweep")]
    data = dict(dataset.attrs)
    data |= {"problem": name, "cases": cases, "seed": seed, "dtype": dtype, "figures": figures}
    table = Table("", "", box=None, show_header=False)
    for key, value in data.items():
        if key != "figures":
            table.add_row(key, Text(f"{value:.6g}" if isinstance(value, float) else str(value)))
    return Outcome(data, [table, *_written(figures)])


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

        picture = plot_flight(flight, _solved(name)[1])
        figures = [_save(picture, out, f"{name}-case-{case}")]
    final = np.asarray(flight.final_state)
    was, same = of_case.get("final_state"), None
    if was is not None:
        rounding = 1e-12 if told["dtype"] == "float64" else 1e-4
        same = bool(np.all(np.abs(final - was) <= rounding * np.maximum(1.0, np.abs(was))))
    data = {
        "problem": name, "case": case, "seed": told["seed"], "t": flight.t, "x": flight.x,
        "u": flight.u, "final_state": final, "stored": was, "same": same, "figures": figures,
        "result": _result(flight.result),
    }  # fmt: skip
    table = Table("", "flown again", "stored", box=None)
    for i, state in enumerate(states):
        old = "not kept" if was is None else f"{float(was[i]):.15g}"
        table.add_row(state, f"{float(final[i]):.15g}", old)
    return Outcome(data, [table, *_written(figures)], same is not False)


@app.command
def doctor(*, common: Common = Common()) -> Outcome:
    """Check versions, devices, precision, the compilation cache, and a known fault of JAX.

    Exits with 1 if a check fails.
    """
    from jaxguide.doctor import report

    checks = report()
    ok = all(check["ok"] for check in checks.values())
    table = Table("", "", "", box=None, show_header=False)
    for name, check in checks.items():
        value = check["value"]
        value = ", ".join(value) if isinstance(value, list) else str(value)
        verdict = Text("ok", "green") if check["ok"] else Text(check["remedy"], "bold red")
        table.add_row(name, Text(value), verdict)
    return Outcome({"ok": ok, "checks": checks}, [table], ok)


COMMANDS = (problems, reproduce, solve, gains, fly, sweep, rerun, doctor)


def _solved(name: str, watch: Any = None) -> tuple[Any, Any]:
    """A problem of the library and its extremal."""
    from jaxguide import problems as library

    problem = library.get(name)
    import jaxguide as jg

    with waiting(RichProgress(f"solve {name}")):
        return problem, jg.solve(problem, watch=watch)


def _result(result: Any) -> dict[str, Any]:
    from jaxguide.types import RESULTS

    message = RESULTS[result]
    return {"ok": bool(result == RESULTS.successful), "message": message}


def _folder(out: Path | None) -> Path | None:
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    return out


def _save(figure: Any, out: Path, stem: str) -> str:
    from jaxguide.plotting import save

    return save(figure, out / f"{stem}.png")


def _written(figures: list[str]) -> list[Text]:
    return [Text("written: " + ", ".join(figures))] if figures else []


def _print_json(data: dict[str, Any]) -> None:
    from jaxguide.reproduce.report import jsonable

    print(json.dumps(jsonable(data), allow_nan=False))


def _fail(error: object, code: int) -> int:
    print(f"jaxguide: {str(error).strip() or type(error).__name__}", file=sys.stderr)
    return code
