"""Published results, computed values beside printed ones: one folder each, imported on demand.

Each module has `run(out: Path | None, progress: Progress | None) -> Report`.
"""

import importlib
from types import ModuleType

from jaxguide.reproduce.report import Report as Report
from jaxguide.reproduce.report import Row as Row
from jaxguide.reproduce.report import Section as Section

_MODULES = {
    "earth-mars": "jaxguide.reproduce.earth_mars",
    "ps-review": "jaxguide.reproduce.ps_review",
    "lunar-launch": "jaxguide.reproduce.lunar_launch",
}


def names() -> tuple[str, ...]:
    """Names of all reproductions."""
    return tuple(_MODULES)


def get(name: str) -> ModuleType:
    """The module that reproduces `name`.

    **Raises:** `UnknownName`, suggesting the nearest name.
    """
    if name not in _MODULES:
        from jaxguide.types import UnknownName

        raise UnknownName("reproduction", name, names())
    return importlib.import_module(_MODULES[name])
