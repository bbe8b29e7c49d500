"""What decides a program of this package, told from its arguments without tracing it.

A trace takes longer than the program that it makes, and ends in one that was kept by an earlier
process. But all that it depends on is this package's source, the versions of others, the shapes
and types of arrays, and static values: these are written to a digest. What somebody else has
written, such as the functions of a Problem, is told by how it is traced on its own, which `foreign`
learns for each kind. Anything that is not understood is `Untold`, and then the program is traced.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib.metadata
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.extend import core

# Packages whose versions, or whose source, stand for their code.
_KNOWN = ("jaxguide", "jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy")
_ROOT = Path(__file__).parent.parent
_PLACES = tuple(f"{path}{os.sep}" for path in (_ROOT, Path(jax.__file__).parent))
_ATOMS = (type(None), bool, int, float, complex, str, bytes)


class Untold(Exception):
    """Something decides a program that this module does not understand."""


def told(function: Callable, arguments: Any) -> str:
    """What decides the program of a known `function` for `arguments`, as a digest.

    **Raises:** `Untold`.
    """
    writer = _Writer()
    writer.write(function)
    writer.write(arguments)
    return writer.digest()


def constants(value: Any) -> str:
    """A digest of `value` in which arrays count by their numbers.

    **Raises:** `Untold`.
    """
    writer = _Writer()
    writer._as_constants([value])
    return writer.digest()


@functools.singledispatch
def foreign(value: Any) -> Any:
    """What a Module of an unknown class stands for: values that tell what its functions do, such as
    a digest of their Jaxpr. To be registered for each kind of class that users write.

    **Raises:** `Untold`.
    """
    raise Untold(type(value))


class _Writer:
    """Writes values to a digest. `constant`: whether arrays are constants of a program, or what it
    is called with, of which only the kind counts; `named`: whether a function's name is enough,
    since what it does is told elsewhere."""

    def __init__(self):
        self._digest = hashlib.sha256()
        self._constant = self._named = False

    def digest(self) -> str:
        return self._digest.hexdigest()

    def write(self, value: Any) -> None:
        if isinstance(value, _ATOMS):
            self._put(type(value).__name__, repr(value))
        elif isinstance(value, (jax.Array, np.ndarray, np.generic)):
            self._array(value)
        elif isinstance(value, (tuple, list)):
            self._class(type(value))
            self._all(value)
        elif isinstance(value, dict):
            self._class(type(value))
            self._all([part for item in value.items() for part in item])
        elif isinstance(value, eqx.Module):
            self._module(value)
        elif isinstance(value, core.ClosedJaxpr):
            self._as_constants(value.consts)
            self._jaxpr(value.jaxpr)
        elif isinstance(value, core.Jaxpr):
            self._jaxpr(value)
        elif isinstance(value, type):
            self._class(value)
        elif isinstance(value, np.dtype):
            self._put("dtype", str(value))
        elif isinstance(value, functools.partial):
            self._all([value.func, value.args, value.keywords])
        elif isinstance(value, (jax.ShapeDtypeStruct, enum.Enum)):
            self._put(type(value).__qualname__, repr(value))
        elif callable(value):
            self._function(value)
        else:
            self._node(value)

    def _node(self, value: Any) -> None:
        """A node of a tree by its class, what it holds, and what is static in it."""
        self._class(type(value))
        node = jax.tree_util.default_registry.flatten_one_level(value)
        if node is None:
            raise Untold(type(value))
        self._all(list(node[0]))
        self._as_constants([node[1]])

    def _put(self, *parts: str) -> None:
        for part in parts:
            data = part.encode()
            self._digest.update(b"%d:" % len(data) + data)

    def _all(self, values: Any) -> None:
        self._put(str(len(values)))
        for value in values:
            self.write(value)

    def _as_constants(self, values: Any) -> None:
        before, self._constant = self._constant, True
        self._all(values)
        self._constant = before

    def _array(self, value: Any) -> None:
        aval = jax.typeof(value)
        self._put(str(aval), str(aval.weak_type))
        if self._constant:
            array = np.asarray(value)
            if array.dtype.hasobject:
                raise Untold(array.dtype)
            self._digest.update(array.tobytes())

    def _class(self, value: type) -> None:
        if _root(value) not in (*_KNOWN, "builtins", "collections") and not self._named:
            raise Untold(value)
        self._put(value.__module__, value.__qualname__)

    def _function(self, value: Any) -> None:
        """A function of a module, without variables of its own; or what this package or JAX made
        of one."""
        plain = value
        while hasattr(plain, "__wrapped__"):
            code = getattr(plain, "__code__", None)
            if code is not None and not code.co_filename.startswith(_PLACES):
                raise Untold(value)
            self._put(type(plain).__qualname__, code.co_name if code else "")
            plain = plain.__wrapped__
        if not isinstance(plain, (types.FunctionType, types.BuiltinFunctionType, np.ufunc)):
            raise Untold(value)
        if getattr(plain, "__closure__", None) or "<" in plain.__qualname__:
            raise Untold(value)
        module = getattr(plain, "__module__", None) or "numpy"
        if module.partition(".")[0] not in _KNOWN and not self._named:
            raise Untold(value)
        self._put(module, plain.__qualname__)

    def _module(self, value: eqx.Module) -> None:
        if _root(type(value)) in _KNOWN:
            part = _Writer()
            part._constant, part._named = self._constant, self._named
            try:
                part._fields(value)
                return self._put(part.digest())
            except Untold:  # a part of it is foreign; perhaps `foreign` knows the whole
                pass
        before = self._named
        try:
            self._as_constants([foreign(value)])
        except Untold:
            if not before:
                raise
        try:
            self._named = True
            self._fields(value)
        finally:
            self._named = before

    def _fields(self, value: eqx.Module) -> None:
        self._class(type(value))
        for field in dataclasses.fields(value):  # pyright: ignore[reportArgumentType]
            if hasattr(value, field.name):
                self._put(field.name)
                write = self._as_constants if field.metadata.get("static") else self._all
                write([getattr(value, field.name)])

    def _jaxpr(self, jaxpr: Any) -> None:
        if jaxpr.effects:
            raise Untold(jaxpr.effects)
        names: dict[Any, int] = {}

        def variables(found: Any) -> None:
            for v in found:
                if isinstance(v, core.Literal):
                    self._as_constants([v.val])
                    self._put(str(v.aval), str(v.aval.weak_type))  # pyright: ignore
                else:
                    self._put(str(names.setdefault(v, len(names))), str(v.aval))
                    self._put(str(getattr(v.aval, "weak_type", None)))

        variables([*jaxpr.constvars, *jaxpr.invars])
        for equation in jaxpr.eqns:
            name = equation.primitive.name
            if equation.primitive not in _primitives() or "callback" in name:
                raise Untold(equation.primitive)
            self._put(name)
            variables(equation.invars)
            variables(equation.outvars)
            for parameter, value in sorted(equation.params.items()):
                self._put(parameter)
                self._parameter(value)
        variables(jaxpr.outvars)

    def _parameter(self, value: Any) -> None:
        """A parameter of an equation. JAX's own kinds are told by how they are printed."""
        source: Any = getattr(value, "debug_info", None)
        if type(value) in (tuple, list):
            self._put(str(len(value)))
            for part in value:
                self._parameter(part)
        elif isinstance(value, (core.Jaxpr, core.ClosedJaxpr, np.ndarray, np.generic, *_ATOMS)):
            self._as_constants([value])
        elif isinstance(value, (type, np.dtype, enum.Enum)):
            self._put(str(value))
        elif source is not None:
            self._rule(source.func_src_info)
        else:
            text = repr(value)
            if _root(type(value)) not in ("jax", "jaxlib") or " at 0x" in text:
                raise Untold(type(value))
            self._put(type(value).__qualname__, text)

    def _rule(self, where: str | None) -> None:
        """A rule of differentiation, by the file that its function stands in; one that JAX itself
        makes of others (`custom_derivatives`) may hold anything."""
        name, _, place = (where or "").partition(" at ")
        known = place.startswith(_PLACES) and "custom_derivatives" not in place
        if not known or "<" in name:
            raise Untold(where)
        self._put(name, Path(place).name)


def _root(kind: type) -> str:
    return kind.__module__.partition(".")[0]


@functools.cache
def _primitives() -> frozenset[core.Primitive]:
    """JAX's own: what others do is not known by a name."""
    modules = [m for name, m in tuple(sys.modules.items()) if name.startswith("jax._src.")]
    found = (p for module in modules for p in vars(module).values())
    return frozenset(p for p in found if isinstance(p, core.Primitive))


@functools.cache
def known_code() -> str:
    """A digest of this package's source and of the versions of all that it calls."""
    digest = hashlib.sha256()
    for name in _KNOWN[1:]:  # the first is this package, which need not be installed
        digest.update(f"{name} {importlib.metadata.version(name)}\n".encode())
    for path in sorted(_ROOT.rglob("*.py")):
        digest.update(str(path.relative_to(_ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()
