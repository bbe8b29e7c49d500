"""The library of problems: every problem of the papers, by name. Host only."""

import importlib
from typing import TYPE_CHECKING, Any

from jaxguide.types import UnknownName

if TYPE_CHECKING:
    from jaxguide.flight.mission import Mission
    from jaxguide.problem import Problem

# name -> (module, Problem class); a module may also offer `mission` and `dispersions`.
_LIBRARY = {"earth-mars": ("earth_mars", "EarthMars")}


def names() -> tuple[str, ...]:
    """Every registered name."""
    return tuple(_LIBRARY)


def _module(name: str) -> Any:
    if name not in _LIBRARY:
        raise UnknownName("problem", name, _LIBRARY)
    return importlib.import_module(f"jaxguide.problems.{_LIBRARY[name][0]}")


def get(name: str) -> "Problem":
    """The problem with its published parameters.

    **Raises:** `UnknownName`, which suggests the nearest name.
    """
    return getattr(_module(name), _LIBRARY[name][1])()


def describe(name: str) -> str:
    """One line about the problem."""
    return (getattr(_module(name), _LIBRARY[name][1]).__doc__ or "").strip().splitlines()[0]


def mission(name: str, **options: Any) -> "Mission":
    """The problem's own closed loop."""
    return _module(name).mission(**options)


def dispersions(name: str) -> dict[str, Any]:
    """The dispersions its sweep draws by default."""
    return _module(name).dispersions()


def __getattr__(name: str) -> Any:
    for module, kind in _LIBRARY.values():
        if kind == name:
            return getattr(importlib.import_module(f"jaxguide.problems.{module}"), kind)
    raise AttributeError(f"module 'jaxguide.problems' has no attribute {name!r}")
