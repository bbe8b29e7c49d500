"""The house rules that a program can see: short functions, docstrings, one name for one thing."""

import ast
import importlib
import inspect
import pkgutil
from collections import defaultdict
from pathlib import Path

import jaxguide as jg

PACKAGE = Path(jg.__file__).parent
_LINES = 80  # of a function; more need a reason beside them
# Functions that are longer, and why.
LONG = {
    "sweep": "fifty of its lines are arguments and their docstring",
    "tune": "fifty of its lines are arguments and their docstring",
}
# Rooms whose functions are named by what they serve: a command line's commands call the library's
# function of the same name; the modules of a registry all have the same few.
COMMANDS, REGISTRIES = "cli", ("problems", "reproduce")


def functions():
    """(file, node) of every function of the package."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                yield path, node


def test_functions_can_be_held():
    length = lambda node: (node.end_lineno or node.lineno) - node.lineno + 1
    long = {node.name for _, node in functions() if length(node) > _LINES}
    assert long <= set(LONG), long - set(LONG)


def modules():
    for found in pkgutil.walk_packages(jg.__path__, "jaxguide."):
        yield importlib.import_module(found.name)


def own(module):
    """Public classes and functions that a module defines."""
    for name, thing in vars(module).items():
        thing = inspect.unwrap(thing) if callable(thing) else thing
        named = inspect.isclass(thing) or inspect.isfunction(thing)
        if named and not name.startswith("_") and thing.__module__ == module.__name__:
            yield name, thing


def says(thing):
    """Whether it, or what it overrides, has words of its own: a dataclass without them has its
    signature for a docstring."""
    doc = inspect.getdoc(thing)
    return bool(doc) and not doc.startswith(f"{thing.__name__}(")


def test_everything_public_is_documented():
    silent = []
    for module in modules():
        for name, thing in own(module):
            if not says(thing):
                silent.append(f"{module.__name__}.{name}")
            if not inspect.isclass(thing):
                continue
            for member, value in vars(thing).items():
                function = value.fget if isinstance(value, property) else value
                function = inspect.unwrap(function) if callable(function) else function
                public = inspect.isfunction(function) and not member.startswith("_")
                if public and function.__module__ == module.__name__:
                    if not inspect.getdoc(getattr(thing, member)):
                        silent.append(f"{module.__name__}.{name}.{member}")
    assert silent == []


def test_one_name_for_one_thing():
    homes = defaultdict(set)
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).parts
        if parts[0] == COMMANDS:
            continue
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, (ast.ClassDef, ast.FunctionDef)) or node.name[0] == "_":
                continue
            if parts[0] not in REGISTRIES or isinstance(node, ast.ClassDef):
                homes[node.name].add("/".join(parts))
    assert {name: sorted(at) for name, at in homes.items() if len(at) > 1} == {}
