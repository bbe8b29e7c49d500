"""`jaxguide doctor`."""

from rich.table import Table
from rich.text import Text

from jaxguide.cli.app import Common, Outcome, app


@app.command
def doctor(*, clear_cache: bool = False, common: Common = Common()) -> Outcome:
    """Check versions, devices, precision, the programs kept, and a known fault of JAX.

    Exits with 1 if a check fails.

    Parameters
    ----------
    clear_cache
        First remove the compiled programs that the package and its command line have kept.
    """
    from jaxguide.doctor import check_installation
    from jaxguide.host import cache

    if clear_cache:
        cache.clear()
    checks = check_installation()
    ok = all(check["ok"] for check in checks.values())
    table = Table("", "", "", box=None, show_header=False)
    for name, check in checks.items():
        value = check["value"]
        value = ", ".join(value) if isinstance(value, list) else str(value)
        verdict = Text("ok", "green") if check["ok"] else Text(check["remedy"], "bold red")
        table.add_row(name, Text(value), verdict)
    return Outcome({"ok": ok, "checks": checks}, [table], ok)
