"""A module imports only from the layers above its own: the order of the package, held by the AST.

Imports inside functions and under TYPE_CHECKING count too.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "jaxguide"

# From the foundations up to the rim.
LAYERS = (
    "types",
    "trig",
    "linalg",
    "spectral",
    "problem",
    "trajectory",
    "sizes",
    "nominal",
    "neighboring",
    "certificate",
    "solving",
    "bellman",
    "laws",
    "flight",
    "progress",
    "montecarlo",
    "batch",
    "tuning",
    "problems",
    "plotting",
    "report",
    "reproduce",
    "export",
    "doctor",
    "jaxguide",  # the public names, jaxguide/__init__.py: for the command line alone
    "cli",
)


def imported(path: Path, root: Path) -> Iterator[str]:
    """Full names of the jaxguide modules that a file imports; `jaxguide` for the package itself."""
    inside = path.relative_to(root.parent).with_suffix("").parts  # jaxguide, layer, ...
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] == "jaxguide")
        elif isinstance(node, ast.ImportFrom):
            base = list(inside[: -node.level]) if node.level else []
            base += node.module.split(".") if node.module else []
            if base == ["jaxguide"]:  # from jaxguide import layer, or a public name
                for a in node.names:
                    known = (root / a.name).is_dir() or (root / f"{a.name}.py").is_file()
                    yield f"jaxguide.{a.name}" if known else "jaxguide"
            elif base and base[0] == "jaxguide":
                yield ".".join(base)


def violations(root: Path) -> list[str]:
    """One line for each import that does not point up, and each module in no layer."""
    found = []
    for path in sorted(root.rglob("*.py")):
        relative = path.relative_to(root)
        layer = relative.parts[0].removesuffix(".py")
        if str(relative) == "__init__.py":
            continue
        if layer not in LAYERS:
            found.append(f"{relative}: {layer!r} is in no layer: place it in LAYERS")
            continue
        for name in imported(path, root):
            other = (name.split(".") + ["jaxguide"])[1] if "." in name else "jaxguide"
            if other == layer:
                continue
            if other not in LAYERS or LAYERS.index(other) > LAYERS.index(layer):
                found.append(f"{relative}: imports {name}, which is not above {layer!r}")
    return found


def test_layers_of_the_package():
    assert violations(PACKAGE) == []


@pytest.mark.parametrize(
    ("path", "line"),
    [
        ("problem.py", "from jaxguide.solving import solve"),
        ("spectral/nodes.py", "import jaxguide.problem"),
        ("spectral/nodes.py", "from ..problem import Problem"),
        ("spectral/nodes.py", "from jaxguide import problem as p"),
        ("laws/gain.py", "import jaxguide as jg"),
        ("laws/gain.py", "from jaxguide import Problem"),
        ("types.py", "def f():\n    from . import problem"),
        ("flight/simulate.py", "from jaxguide.nowhere import f"),
        ("stray.py", "import jax"),
    ],
)
def test_checker_sees_an_upward_import(tmp_path, path, line):
    root = tmp_path / "jaxguide"
    sound = {
        "__init__.py": "from jaxguide.solving import solve as solve",
        "types.py": "import jax",
        "problem.py": "from jaxguide.types import RESULTS",
        "spectral/nodes.py": "from jaxguide.types import RESULTS\nfrom . import matrices",
        "spectral/matrices.py": "from jaxguide.spectral import nodes",
        "laws/gain.py": "from jaxguide import problem\nfrom ..problem import Problem",
        "flight/simulate.py": "import jaxguide.laws.gain",
        "solving.py": "import jaxguide.problem as problem",
        "cli.py": "import jaxguide as jg",
    }
    for name, text in sound.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    assert violations(root) == []
    (root / path).write_text(line)
    found = violations(root)
    assert len(found) == 1 and path in found[0]
