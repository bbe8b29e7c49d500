"""The library of problems, missions and designs, by name. Host only."""

import importlib
from typing import TYPE_CHECKING, Any

from jaxguide.problems.reference import Reference
from jaxguide.types import UnknownName

if TYPE_CHECKING:
    from jaxguide.flight.mission import Mission
    from jaxguide.problem import Problem
    from jaxguide.tuning.ready import Ready

# name -> (module, Problem class); a module may also offer `mission` and `dispersions`.
_LIBRARY = {
    "earth-mars": ("earth_mars", "EarthMars"),
    "double-integrator": ("linear_quadratic", "DoubleIntegratorEffort"),
    "free-end-velocity": ("linear_quadratic", "FreeEndVelocity"),
    "bryson-denham": ("linear_quadratic", "BrysonDenham"),
    "beam": ("linear_quadratic", "Beam"),
    "scalar-regulator": ("linear_quadratic", "ScalarRegulator"),
    "weighted-regulator": ("linear_quadratic", "WeightedRegulator"),
    "two-thrusters": ("linear_quadratic", "TwoThrusters"),
    "robbins": ("linear_quadratic", "Robbins"),
    "brachistochrone": ("steering", "Brachistochrone"),
    "brachistochrone-dymos": ("steering", "BrachistochroneDymos"),
    "brachistochrone-wall": ("steering", "BrachistochroneWall"),
    "linear-tangent-steering": ("steering", "LinearTangentSteering"),
    "hanging-chain": ("steering", "HangingChain"),
    "isoperimetric": ("steering", "Isoperimetric"),
    "hypersensitive": ("oscillators", "Hypersensitive"),
    "rayleigh": ("oscillators", "Rayleigh"),
    "van-der-pol": ("oscillators", "VanDerPol"),
    "fuller": ("oscillators", "Fuller"),
    "singular5": ("oscillators", "Singular5"),
    "catalyst-mixing": ("reactors", "CatalystMixing"),
    "jackson": ("reactors", "Jackson"),
    "tumour": ("reactors", "Tumour"),
    "moon-lander": ("vehicles", "MoonLander"),
    "goddard": ("vehicles", "Goddard"),
    "goddard-speed-limit": ("vehicles", "GoddardSpeedLimit"),
    "robot-arm": ("vehicles", "RobotArm"),
    "free-flying-robot": ("vehicles", "FreeFlyingRobot"),
    "hang-glider": ("vehicles", "HangGlider"),
    "shuttle-reentry": ("shuttle", "ShuttleReentry"),
    "shuttle-reentry-heat": ("shuttle", "ShuttleReentryHeat"),
    "npsat1": ("npsat1", "NPSAT1"),
    "lunar-launch": ("lunar_launch", "LunarLaunch"),
    "delta-iii": ("delta_iii", "DeltaIII"),
}

# name -> (module of jaxguide.problems.designs, function)
_DESIGNS = {
    "earth-mars": ("earth_mars", "design"),
    "earth-mars-history": ("earth_mars", "history"),
    "lunar-launch": ("lunar_launch", "design"),
    "moon-lander": ("moon_lander", "design"),
}


def names() -> tuple[str, ...]:
    """Names of all problems."""
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
    """The first line of the problem's docstring.

    **Raises:** `UnknownName`, which suggests the nearest name.
    """
    return (getattr(_module(name), _LIBRARY[name][1]).__doc__ or "").strip().splitlines()[0]


def reference(name: str) -> Reference:
    """The known optimum of the problem, and its source.

    **Raises:** `UnknownName`, which suggests the nearest name.
    """
    return getattr(_module(name), _LIBRARY[name][1]).reference


def mission(name: str, **options: Any) -> "Mission":
    """The problem's own closed loop.

    **Arguments:** `options`: of the `mission` in the problem's module.

    **Raises:** `UnknownName`; `ValueError`, naming the problems that have one, if it has none.
    """
    return _offered(name, "mission")(**options)


def dispersions(name: str) -> dict[str, Any]:
    """The dispersions that a sweep of the problem's own closed loop draws by default.

    **Raises:** as `mission`.
    """
    return _offered(name, "dispersions")()


def designs() -> tuple[str, ...]:
    """Names of the designs ready to tune."""
    return tuple(_DESIGNS)


def design(name: str, **options: Any) -> "Ready":
    """A design ready to tune, as by `jaxguide tune`.

    **Arguments:** `options`: of the design's own function.

    **Raises:** `UnknownName`, which suggests the nearest name.
    """
    if name not in _DESIGNS:
        raise UnknownName("design", name, _DESIGNS)
    module, function = _DESIGNS[name]
    return getattr(importlib.import_module(f"jaxguide.problems.designs.{module}"), function)(
        **options
    )


def _offered(name: str, what: str) -> Any:
    if not hasattr(_module(name), what):
        have = [k for k in _LIBRARY if hasattr(_module(k), what)]
        raise ValueError(
            f"problem {name!r} has no {what} of its own; {', '.join(have)} does. In Python, build "
            "a jg.Mission from any extremal."
        )
    return getattr(_module(name), what)


def __getattr__(name: str) -> Any:
    for module, kind in _LIBRARY.values():
        if kind == name:
            return getattr(importlib.import_module(f"jaxguide.problems.{module}"), kind)
    raise AttributeError(f"module 'jaxguide.problems' has no attribute {name!r}")
