"""Dispersions as text: read from a TOML or YAML file, and written as plain data. Host only."""

import dataclasses
import difflib
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from jaxguide.montecarlo.dispersions import (
    Distribution,
    LogNormal,
    MultivariateNormal,
    Normal,
    Relative,
    TruncatedNormal,
    Uniform,
)

KINDS: dict[str, type[Distribution]] = {
    "normal": Normal,
    "uniform": Uniform,
    "truncated-normal": TruncatedNormal,
    "log-normal": LogNormal,
    "relative": Relative,
    "multivariate-normal": MultivariateNormal,
}


def dispersions_from(source: Any) -> dict[Any, Distribution]:
    """Dispersions from a TOML or YAML file (YAML needs PyYAML), or from the same as a dictionary.

    One table for each leaf of the mission, named by its dotted path, or by several paths with
    commas between them if they are drawn together; `kind` is one of normal, uniform,
    truncated-normal, log-normal, relative, multivariate-normal, and the other keys are the
    arguments of `jg.Normal` and its kin:

        [initial_state]
        kind = "normal"
        std = [1e-3, 1e-3, 1e-3]

        [plant.thrust]
        kind = "relative"
        distribution = { kind = "normal", std = 0.01 }

    **Returns:** path (a tuple of paths for several) -> distribution, as `jg.sweep` takes it.

    **Raises:** `ValueError` that names the file, the key, the value and the remedy; `OSError` where
    there is no such file.
    """
    if isinstance(source, dict):
        return {path: _distribution(told, path) for path, told in _tables(source, "")}
    file = Path(source)
    try:
        return dispersions_from(_parsed(file))
    except ValueError as e:
        raise ValueError(f"{file}: {e}") from e


def as_written(dispersions: dict[Any, Distribution]) -> dict[str, Any] | None:
    """What `dispersions_from` would read back, as plain data; None for classes that it does not
    know."""
    try:
        return {
            path if isinstance(path, str) else ", ".join(path): _told(distribution)
            for path, distribution in dispersions.items()
        }
    except TypeError:
        return None


def _parsed(file: Path) -> dict[str, Any]:
    if file.suffix == ".toml":
        with file.open("rb") as stream:
            return tomllib.load(stream)  # TOMLDecodeError, a ValueError, has line and column
    if file.suffix not in (".yaml", ".yml"):
        raise ValueError(f"ends in {file.suffix!r}; give a .toml, .yaml or .yml file.")
    try:
        import yaml
    except ImportError as e:
        raise ValueError("YAML needs PyYAML; install it, or write TOML.") from e
    try:
        told = yaml.safe_load(file.read_text())  # makes plain data only
    except yaml.YAMLError as e:
        raise ValueError(f"is no plain YAML: {e}") from e
    if not isinstance(told, dict):
        raise ValueError("holds no tables; see jg.dispersions_from for what to write.")
    return told


def _tables(source: dict[str, Any], prefix: str) -> Any:
    """(path, table) of each table with a kind; those without one lead on to others."""
    for key, value in source.items():
        path = f"{prefix}{key}"
        if not isinstance(value, dict):
            raise ValueError(
                f"{path} is {value!r}; give a table with a kind, such as "
                f'{{ kind = "normal", std = 0.01 }}.'
            )
        if "kind" in value:
            paths = tuple(part.strip() for part in path.split(","))
            yield (paths if len(paths) > 1 else path), value
        else:
            if not value:
                raise ValueError(f"{path} is empty; give it a kind.")
            yield from _tables(value, f"{path}.")


def _distribution(told: Any, path: Any) -> Distribution:
    name = path if isinstance(path, str) else ", ".join(path)
    if not isinstance(told, dict) or "kind" not in told:
        raise ValueError(f"{name} is {told!r}; give a table with a kind.")
    kind = KINDS.get(str(told["kind"]))
    if kind is None:
        near = difflib.get_close_matches(str(told["kind"]), KINDS, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(KINDS)}."
        raise ValueError(f"{name}: kind is {told['kind']!r}; {hint}")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    given = {}
    for key, value in told.items():
        if key == "kind":
            continue
        if key not in fields:
            near = difflib.get_close_matches(key, fields, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(fields)}."
            raise ValueError(f"{name}: {told['kind']} has no {key!r}; {hint}")
        if key == "distribution":
            given[key] = _distribution(value, f"{name}.distribution")
        else:
            given[key] = _numbers(value, f"{name}: {key}")
    missing = [k for k, f in fields.items() if f.default is dataclasses.MISSING and k not in given]
    if missing:
        raise ValueError(f"{name}: {told['kind']} needs {', '.join(missing)}; give it.")
    try:
        return kind(**given)
    except ValueError as e:
        raise ValueError(f"{name}: {e}") from e


def _numbers(value: Any, where: str) -> Any:
    """A number as it is, a list of them as an array."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    try:
        if isinstance(value, list):
            return np.asarray(value, float)
    except (TypeError, ValueError):
        pass
    raise ValueError(f"{where} is {value!r}; give a number or a list of numbers.")


def _told(distribution: Distribution) -> dict[str, Any]:
    names = {kind: name for name, kind in KINDS.items()}
    if type(distribution) not in names:
        raise TypeError(type(distribution))
    told: dict[str, Any] = {"kind": names[type(distribution)]}
    for field in dataclasses.fields(distribution):
        value = getattr(distribution, field.name)
        told[field.name] = (
            _told(value) if isinstance(value, Distribution) else np.asarray(value, float).tolist()
        )
    return told
