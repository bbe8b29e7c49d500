"""What a sweep's bits depend on, as digests by name: two sweeps of one identity give the same bits
on machines of one kind.

The equations of flight are read off the programs that a sweep runs, lowered to StableHLO, not off
the files that they came from. Host only.
"""

import dataclasses
import functools
import hashlib
import inspect
import json
import sys
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.host import flags
from jaxguide.sweeping import importance, ranking, tally
from jaxguide.sweeping.syntax import syntax_of
from jaxguide.sweeping.tiles import Order, Tiles
from jaxguide.sweeping.written import as_written

_DIGITS = 16  # hexadecimal digits of a digest: 64 bits, enough to tell stores of one user apart
# The host's code that makes the stored sums from the rows of a tile.
_SUMS = (tally, importance, ranking, Tiles)
# The lowered programs show what these define, so its name is enough.
_OTHERS = ("equinox", "jax", "numpy", "scipy", "diffrax", "lineax", "optimistix", "optax")
_LIBRARIES = {"jaxguide", *_OTHERS, *sys.stdlib_module_names}


def manifest(order: Order, programs: dict[str, str]) -> dict[str, Any]:
    """Names and digests: seed and size, software, programs, every part of the mission and every
    dispersion.

    **Arguments:** `programs`: name -> text, as by `Tiles.programs`.
    """
    mission = {
        name: digest(getattr(order.mission, name)) for name in order.mission.__dataclass_fields__
    }
    return {
        "cases": order.cases,
        "seed": order.seed,
        "tile": order.tile,
        "sampling": order.sampling,
        "dtype": str(order.mission.initial_state.dtype),
        "jax": jax.__version__,
        "xla": flags.deciding(),
        "programs": {name: _hashed(text) for name, text in programs.items()},
        "sums": _digest_of_sums(),
        "mission": mission,
        "dispersions": {
            str(path): _of_dispersion(path, d) for path, d in order.dispersions.items()
        },
    }


def _of_dispersion(path: Any, distribution: Any) -> str:
    """Digest of the text form where there is one, so that a distribution read from a file has the
    digest of the same one written in Python."""
    written = as_written({path: distribution})
    if written is None:
        return digest(distribution)
    return _hashed(json.dumps(written, sort_keys=True))


def about(order: Order) -> dict[str, Any]:
    """For people: the numbers of the plant, the law and the dispersions of a sweep."""
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
    """Digest of the numbers and the structure of `tree`, and of the syntax of the user's own
    classes and functions in it."""
    sha = hashlib.sha256()
    for text in _texts(tree, ()):
        sha.update(text.encode())
        sha.update(b"\n")
    return sha.hexdigest()[:_DIGITS]


def _hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


@functools.cache
def _digest_of_sums() -> str:
    return _hashed("\n".join(map(syntax_of, _SUMS)))


def _texts(value: Any, above: tuple[int, ...]) -> Iterator[str]:
    """`value` as lines of text, the same in every process. `above`: the identities of the objects
    that `value` lies in, some of which a function may hold itself."""
    if callable(value) and not isinstance(value, type):
        value = inspect.unwrap(value)  # of `jax.jit`, say
    if id(value) in above:
        yield "itself"
        return
    above = (*above, id(value))
    if eqx.is_array_like(value):
        yield from _of_array(value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield from _of_class(type(value))
        for field in dataclasses.fields(value):
            yield field.name
            yield from _texts(getattr(value, field.name, None), above)
    elif isinstance(value, dict):
        for key in sorted(value, key=str):
            yield str(key)
            yield from _texts(value[key], above)
    elif isinstance(value, (tuple, list)):
        yield f"{type(value).__name__} of {len(value)}"
        for item in value:
            yield from _texts(item, above)
    elif isinstance(value, (set, frozenset)):
        yield from sorted(digest(item) for item in value)
    elif isinstance(value, functools.partial):
        yield from _texts((value.func, value.args, value.keywords), above)
    elif isinstance(value, type):
        yield from _of_class(value)
    elif callable(value) and hasattr(value, "__qualname__"):
        yield from _of_function(value, above)
    elif type(value).__repr__ is object.__repr__:  # which would show its address
        yield from _of_class(type(value))
        yield from _texts(getattr(value, "__dict__", {}), above)
    else:
        yield f"{type(value).__qualname__} {value!r}"


def _of_array(value: Any) -> Iterator[str]:
    if eqx.is_array(value) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    array = np.asarray(value)
    yield f"{array.dtype}{array.shape}"
    yield hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def _of_class(kind: type) -> Iterator[str]:
    """Its name and syntax, and those of the classes of the user that it inherits from."""
    for each in kind.__mro__:
        yield _name(each)
        if not _of_library(each):
            yield _syntax(each)


def _of_function(function: Any, above: tuple[int, ...]) -> Iterator[str]:
    """Its name, syntax, defaults, and the values that it captured."""
    yield _name(function)
    if not _of_library(function):
        yield _syntax(function)
    elif not str(function.__module__).startswith("jaxguide"):
        return
    owner = getattr(function, "__self__", None)
    if owner is not None:
        yield from _texts(owner, above)
    yield from _texts(getattr(function, "__defaults__", None), above)
    yield from _texts(getattr(function, "__kwdefaults__", None), above)
    for cell in getattr(function, "__closure__", None) or ():
        try:
            captured = cell.cell_contents
        except ValueError:  # a name that has no value yet
            continue
        yield from _texts(captured, above)


def _name(thing: Any) -> str:
    return f"{thing.__module__}.{thing.__qualname__}"


def _of_library(thing: Any) -> bool:
    return str(thing.__module__).split(".")[0] in _LIBRARIES


def _syntax(thing: Any) -> str:
    try:
        return syntax_of(thing)
    except (OSError, TypeError):  # no source: the lowered programs see what it does
        return ""
