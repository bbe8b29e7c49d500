"""The command line. Heavy imports wait inside the commands, so that `--help` is quick.

Each command returns an `Outcome`; `main` alone prints, reports errors and sets the exit code:
0 done, 1 failed or out of tolerance, 2 wrong usage.
"""

import contextlib
import gc
import json
import os
import sys
from typing import Any

from cyclopts import CycloptsError
from rich.console import Console

from jaxguide.cli import checking, reporting, solving, sweeping, tuning
from jaxguide.cli.app import Common, app
from jaxguide.host import cache

COMMANDS = (
    *(solving.problems, solving.reproduce, solving.solve, solving.gains, solving.fly),
    *(sweeping.sweep, sweeping.rerun, reporting.report, reporting.export, reporting.compare),
    tuning.tune,
    checking.doctor,
)


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
    if "jax" not in sys.modules:
        sweeping.options_of_xla(command, bound.arguments)
    configure(_keeps_all(command, bound.arguments))
    stdout = sys.stdout
    try:
        # With --json nothing else may reach stdout, not even a library's print.
        with contextlib.redirect_stdout(sys.stderr if common.json else stdout):
            outcome = command(*bound.args, **bound.kwargs)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    # The library's own errors (UnknownName is a ValueError, Equinox's and XLA's errors are
    # RuntimeErrors), unwritable folders, missing extras. Anything else is a bug, whose traceback
    # is needed.
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


def _keeps_all(command: Any, arguments: dict[str, Any]) -> bool:
    """Whether the package itself keeps the programs of the command: all that take long."""
    if command is solving.reproduce:
        return arguments["name"] == "earth-mars"
    return command is not tuning.tune


def configure(kept: bool = False) -> None:
    """float64, and a compilation cache that lasts, for this process.

    Called before JAX and Equinox are imported: both read the environment when imported.

    **Arguments:** `kept`: whether the package's own cache (`jaxguide.host.executables`), which
    finds a program without tracing it, is enough.
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
    # JAX's own cache holds every program, those of tuning too; the package's then stands aside.
    given = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if given is None and not (kept and cache.folder()):
        jax.config.update("jax_compilation_cache_dir", str(cache.folder_of_jax()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _print_json(data: dict[str, Any]) -> None:
    from jaxguide.reproduce.report import jsonable

    print(json.dumps(jsonable(data), allow_nan=False))


def _fail(error: object, code: int) -> int:
    print(f"jaxguide: {str(error).strip() or type(error).__name__}", file=sys.stderr)
    return code
