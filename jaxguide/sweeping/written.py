"""Dispersions as plain data: read from a TOML or YAML file, and written again. Host only."""

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

    **Raises:** `ValueError` that names the file, the key, the value and the remedy; `OSError` if
    there is no such file.
    """
    if isinstance(source, dict):
        return {path: _distribution(table, path) for path, table in _tables(source, "")}
    file = Path(source)
    try:
        return dispersions_from(_parsed(file))
    except ValueError as e:
        raise ValueError(f"{file}: {e}") from e


def as_written(dispersions: dict[Any, Distribution]) -> dict[str, Any] | None:
    """`dispersions` as plain data that `dispersions_from` reads back; None if one of them is of a
    class that it does not know."""
    try:
        return {
            path if isinstance(path, str) else ", ".join(path): _table_of(distribution)
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
        tables = yaml.safe_load(file.read_text())  # makes plain data only
    except yaml.YAMLError as e:
        raise ValueError(f"is no plain YAML: {e}") from e
    if not isinstance(tables, dict):
        raise ValueError("holds no tables; see jg.dispersions_from for the form.")
    return tables


def _tables(source: dict[str, Any], prefix: str) -> Any:
    """(path, table) of each table with a `kind`; a table without one holds other tables."""
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


def _distribution(table: Any, path: Any) -> Distribution:
    name = path if isinstance(path, str) else ", ".join(path)
    if not isinstance(table, dict) or "kind" not in table:
        raise ValueError(f"{name} is {table!r}; give a table with a kind.")
    kind = KINDS.get(str(table["kind"]))
    if kind is None:
        near = difflib.get_close_matches(str(table["kind"]), KINDS, 1)
        hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(KINDS)}."
        raise ValueError(f"{name}: kind is {table['kind']!r}; {hint}")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    given = {}
    for key, value in table.items():
        if key == "kind":
            continue
        if key not in fields:
            near = difflib.get_close_matches(key, fields, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(fields)}."
            raise ValueError(f"{name}: {table['kind']} has no {key!r}; {hint}")
        if key == "distribution":
            given[key] = _distribution(value, f"{name}.distribution")
        else:
            given[key] = _numbers(value, f"{name}: {key}")
    missing = [k for k, f in fields.items() if f.default is dataclasses.MISSING and k not in given]
    if missing:
        raise ValueError(f"{name}: {table['kind']} needs {', '.join(missing)}; give it.")
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


def _table_of(distribution: Distribution) -> dict[str, Any]:
    """The table from which `_distribution` makes `distribution`.

    **Raises:** `TypeError` for a class that is none of `KINDS`.
    """
    names = {kind: name for name, kind in KINDS.items()}
    if type(distribution) not in names:
        raise TypeError(type(distribution))
    table: dict[str, Any] = {"kind": names[type(distribution)]}
    for field in dataclasses.fields(distribution):
        value = getattr(distribution, field.name)
        nested = isinstance(value, Distribution)
        table[field.name] = _table_of(value) if nested else np.asarray(value, float).tolist()
    return table
