"""What a sweep's bits depend on, as digests by name: two sweeps of one identity give the same bits
on machines of one kind. Host only."""

import dataclasses
import functools
import hashlib
import inspect
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxguide.host import flags
from jaxguide.sweeping.tiles import Order
from jaxguide.sweeping.written import as_written

_RIM = ("reproduce", "cli", "plotting", "report", "export", "doctor", "tuning")


def manifest(order: Order) -> dict[str, Any]:
    """Names and digests: code, seed and size, every part of the mission, every dispersion."""
    mission = {
        name: digest(getattr(order.mission, name)) for name in order.mission.__dataclass_fields__
    }
    spread = {str(path): _told(path, value) for path, value in order.dispersions.items()}
    return {
        "cases": order.cases,
        "seed": order.seed,
        "tile": order.tile,
        "sampling": order.sampling,
        "dtype": str(order.mission.initial_state.dtype),
        "jax": jax.__version__,
        "xla": flags.deciding(),
        "jaxguide": _package(),
        "mission": mission,
        "dispersions": spread,
    }


def _told(path: Any, distribution: Any) -> str:
    """Of a distribution that can be written, what is written: read from a file, it is the same."""
    written = as_written({path: distribution})
    if written is None:
        return digest(distribution)
    return hashlib.sha256(json.dumps(written, sort_keys=True).encode()).hexdigest()[:16]


def about(order: Order) -> dict[str, Any]:
    """For people: what was flown, and by what it was dispersed."""
    plant = order.mission.plant
    numbers = {
        field.name: np.asarray(value).tolist()
        for field in dataclasses.fields(plant)
        if eqx.is_array_like(value := getattr(plant, field.name)) and np.ndim(value) < 2
    }
    control = [str(name) for name in plant.control_names]
    return {
        "plant": {"class": type(plant).__qualname__, "controls": control, **numbers},
        "law": type(order.mission.law).__qualname__,
        "sample_interval": np.asarray(order.mission.sample_interval).tolist(),
        "dispersions": as_written(order.dispersions)
        or {str(path): repr(value) for path, value in order.dispersions.items()},
        "written": as_written(order.dispersions) is not None,
    }


def digest(tree: Any) -> str:
    """Of the numbers in `tree`, its structure, and the source of its classes and functions."""
    sha = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        sha.update(jax.tree_util.keystr(path).encode())
        if eqx.is_array_like(leaf):
            value = np.asarray(leaf)
            sha.update(f"{value.dtype}{value.shape}".encode())
            sha.update(np.ascontiguousarray(value).tobytes())
        else:
            sha.update(_source(leaf).encode())
    for node in _nodes(tree):
        sha.update(_source(type(node)).encode())
        for field in dataclasses.fields(node):
            if field.metadata.get("static", False):
                value = getattr(node, field.name)
                told = _source(value) if callable(value) else repr(value)
                sha.update(f"{field.name}={told}".encode())
    return sha.hexdigest()[:16]


def _nodes(tree: Any) -> list[Any]:
    """Every Equinox module within `tree`."""
    if isinstance(tree, eqx.Module):
        return [
            tree,
            *(n for f in dataclasses.fields(tree) for n in _nodes(getattr(tree, f.name))),
        ]
    if isinstance(tree, (tuple, list)):
        return [n for item in tree for n in _nodes(item)]
    if isinstance(tree, dict):
        return [n for key in sorted(tree, key=str) for n in _nodes(tree[key])]
    return []


def _source(thing: Any) -> str:
    """Name and source of a class or function; its own code is part of `_package`."""
    name = f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', repr(type(thing)))}"
    if name.startswith("jaxguide."):
        return name
    try:
        name += inspect.getsource(thing)
    except (OSError, TypeError):  # built in, or typed at a prompt
        pass
    captured = [cell.cell_contents for cell in getattr(thing, "__closure__", None) or ()]
    return name + "".join(digest(value) for value in captured)


@functools.cache
def _package() -> str:
    """A digest of this package's own files, but for those that no flight passes through."""
    sha = hashlib.sha256()
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        if file.relative_to(root).parts[0].removesuffix(".py") not in _RIM:
            sha.update(file.relative_to(root).as_posix().encode())
            sha.update(file.read_bytes())
    return sha.hexdigest()[:16]
