"""A module imports only what stands before it: the order of the package and inside its rooms, held
by the AST.

Imports inside functions and under TYPE_CHECKING count too.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "jaxguide"

# Each room from its foundations up; "" is the package itself. A room that is not named here holds
# files that do not build on each other, or, at the rim, in any order without a circle.
ORDER: dict[str, tuple[str, ...]] = {
    "": (
        "types",
        "trig",
        "linalg",
        "arrays",
        "bounds",
        "host",
        "spectral",
        "problem",
        "conditions",
        "trajectory",
        "transforms",
        "nominal",
        "neighboring",
        "certificate",
        "solving",
        "laws",
        "flight",
        "montecarlo",
        "sweeping",
        "tuning",
        "problems",
        "plotting",
        "report",
        "reproduce",
        "export",
        "doctor",
        "jaxguide",  # the public names, jaxguide/__init__.py: for the command line alone
        "cli",
    ),
    "spectral": (
        "nodes",
        "families",
        "barycentric",
        "grids",
        "extremes",
        "interpolation",
        "maps",
        "transforms",
        "matrices",
        "either",
    ),
    "problem": (
        "statement",
        "parameters",
        "counts",
        "points",
        "boundary",
        "validation",
        "told",
    ),
    "conditions": ("hamiltonian", "control", "canonical", "angles", "units", "sizes", "bounded"),
    "transforms": ("wrapped", "integrals", "relaxed", "endless", "phased", "state_as_time"),
    "nominal": (
        "steps",
        "roots",
        "ends",
        "starts",
        "defects",
        "method",
        "guesses",
        "direct",
        "indirect",
        "parametric",
        "refinement",
    ),
    "nominal.direct": (
        "collocation",
        "unknowns",
        "stated",
        "transcription",
        "trees",
        "implied",
        "limits",
        "box",
        "newton_system",
        "elimination",
        "kkt_factor",
        "kkt_step",
        "interior_point",
        "implicit",
        "covectors",
        "scaling",
        "guess",
        "warm",
        "stationary",
        "pseudospectral",
    ),
    "nominal.direct.interior_point": (
        "filter",
        "state",
        "evaluation",
        "direction",
        "barrier",
        "line_search",
        "transition",
        "log",
        "loop",
    ),
    "nominal.indirect": ("boundary", "coarse", "starts", "guess", "laying", "shot", "shooting"),
    "nominal.parametric": ("flow", "equality", "extremal", "piecewise_linear"),
    "nominal.refinement": (
        "arcs",
        "meshes",
        "marks",
        "layout",
        "soundness",
        "structured",
        "refine",
        "ladder",
    ),
    "neighboring": (
        "linearization",
        "collocated",
        "breaks",
        "sweep",
        "segmented",
        "sufficiency",
        "costate_gains",
        "propagation",
        "gain_map",
        "gains",
        "suboptimal",
    ),
    "certificate": ("table", "along", "checks", "costly", "certify", "certified"),
    "solving": ("given", "diagnosis", "solve", "batch", "bellman"),
    "laws": (
        "law",
        "lanes",
        "plain",
        "holds",
        "gain_interpolation",
        "neighboring",
        "suboptimal",
    ),
    "flight": (
        "sensors",
        "estimators",
        "disturbances",
        "actuators",
        "integrators",
        "horizon",
        "mission",
        "sample",
        "simulate",
    ),
    "montecarlo": ("dispersions", "sampling", "statistics", "rollouts", "miss", "covariance"),
    "sweeping": (
        "tally",
        "importance",
        "ranking",
        "totals",
        "written",
        "syntax",
        "tiles",
        "histories",
        "identity",
        "stopping",
        "keeping",
        "store",
        "station",
        "cluster",
        "compare",
        "chunks",
        "sweep",
    ),
    "tuning": (
        "variables",
        "counts",
        "measures",
        "meshes",
        "flown",
        "relaxation",
        "thinned",
        "risk",
        "record",
        "loop",
        "ready",
    ),
}
RIM = ("host", "problems", "plotting", "report", "reproduce", "cli")


def imported(path: Path, root: Path) -> Iterator[str]:
    """Full names of the jaxguide modules that a file imports; `jaxguide` for the package itself."""
    inside = path.relative_to(root.parent).with_suffix("").parts  # jaxguide, room, ...
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] == "jaxguide")
        elif isinstance(node, ast.ImportFrom):
            base = list(inside[: -node.level]) if node.level else []
            base += node.module.split(".") if node.module else []
            if not base or base[0] != "jaxguide":
                continue
            here = root.joinpath(*base[1:])
            for a in node.names:  # from jaxguide.room import file, or a name of the room's face
                known = (here / a.name).is_dir() or (here / f"{a.name}.py").is_file()
                yield ".".join([*base, a.name] if known else base)


def modules(root: Path) -> dict[Path, tuple[str, ...]]:
    """Every file but the public names, by the rooms that lead to it: (nominal, direct, kkt). A
    room's own `__init__` counts as the room."""
    out = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts != ("__init__",):
            out[path] = parts[:-1] if parts[-1] == "__init__" else parts
    return out


def violations(root: Path) -> list[str]:
    """One line for each import that does not point down, and each module that has no place."""
    found = []
    for path, parts in modules(root).items():
        where = path.relative_to(root)
        for depth, name in enumerate(parts):
            room = ".".join(parts[:depth])
            if room in ORDER and name not in ORDER[room]:
                found.append(f"{where}: {name!r} is in no room: place it in ORDER[{room!r}]")
                break
        else:
            for name in imported(path, root):
                other = tuple(name.split(".")[1:]) or ("jaxguide",)
                depth = 0
                while depth < min(len(parts), len(other)) and parts[depth] == other[depth]:
                    depth += 1
                if depth in (len(parts), len(other)):
                    continue  # a room's face and its files: one room
                order = ORDER.get(".".join(parts[:depth]))
                if order is None:
                    continue
                here, there = parts[depth], other[depth]
                if there not in order or order.index(there) > order.index(here):
                    found.append(f"{where}: imports {name}, which does not stand before {here!r}")
    return found


def circle(root: Path) -> list[str]:
    """Files that import each other in a loop, one of them; [] if there is none."""
    names = {".".join(("jaxguide", *parts)): path for path, parts in modules(root).items()}
    done: set[str] = set()

    def visit(name: str, way: list[str]) -> list[str]:
        if name in way:
            return way[way.index(name) :]
        if name in done or name not in names:
            return []
        for other in imported(names[name], root):
            if other != name and (loop := visit(other, [*way, name])):
                return loop
        done.add(name)
        return []

    return next((loop for name in names if (loop := visit(name, []))), [])


def test_every_import_points_down():
    assert violations(PACKAGE) == []


def test_every_import_is_there():
    """Imports inside functions run late: a file that was moved is missed at once."""
    known = {".".join(("jaxguide", *parts)) for parts in modules(PACKAGE).values()}
    rooms = {name.rpartition(".")[0] for name in known} | {"jaxguide"}
    absent = [
        f"{path.relative_to(PACKAGE)}: {name}"
        for path in modules(PACKAGE)
        for name in imported(path, PACKAGE)
        if name not in known | rooms
    ]
    assert absent == []


def test_no_circle():
    assert circle(PACKAGE) == []


def test_every_room_has_an_order():
    rooms = {".".join(parts[:d]) for parts in modules(PACKAGE).values() for d in range(len(parts))}
    free = {room for room in rooms if room.split(".")[0] in RIM}
    assert rooms - free == set(ORDER)
    for room, order in ORDER.items():
        there = {parts[room.count(".") + 1 if room else 0]
                 for parts in modules(PACKAGE).values()
                 if not room or ".".join(parts).startswith(f"{room}.")}  # fmt: skip
        assert set(order) - {"jaxguide"} == there, room


@pytest.mark.parametrize(
    ("path", "line"),
    [
        ("problem/statement.py", "from jaxguide.solving.solve import solve"),
        ("spectral/nodes.py", "import jaxguide.problem"),
        ("spectral/nodes.py", "from ..problem import Problem"),
        ("spectral/nodes.py", "from jaxguide import problem as p"),
        ("spectral/nodes.py", "from jaxguide.spectral import matrices"),
        ("laws/law.py", "import jaxguide as jg"),
        ("laws/law.py", "from jaxguide import Problem"),
        ("laws/law.py", "def f():\n    from jaxguide.laws.holds import History"),
        ("types.py", "def f():\n    from . import problem"),
        ("flight/simulate.py", "from jaxguide.nowhere import f"),
        ("stray.py", "import jax"),
        ("spectral/stray.py", "import jax"),
    ],
)
def test_checker_sees_an_upward_import(tmp_path, path, line):
    root = tmp_path / "jaxguide"
    sound = {
        "__init__.py": "from jaxguide.solving.solve import solve as solve",
        "types.py": "import jax",
        "problem/statement.py": "from jaxguide.types import RESULTS",
        "problem/__init__.py": "from jaxguide.problem.statement import Problem as Problem",
        "spectral/nodes.py": "from jaxguide.types import RESULTS",
        "spectral/matrices.py": "from jaxguide.spectral import nodes\nfrom . import nodes",
        "laws/law.py": "from jaxguide import problem\nfrom ..problem import Problem",
        "laws/holds.py": "from jaxguide.laws.law import Law",
        "flight/simulate.py": "import jaxguide.laws.law",
        "solving/solve.py": "import jaxguide.problem as problem",
        "cli/app.py": "import jaxguide as jg",
    }
    for name, text in sound.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    assert violations(root) == [] and circle(root) == []
    (root / path).write_text(line)
    found = violations(root)
    assert len(found) == 1 and path in found[0]


def test_checker_sees_a_circle(tmp_path):
    root = tmp_path / "jaxguide"
    for name, other in (("a", "b"), ("b", "a")):
        (root / "report").mkdir(parents=True, exist_ok=True)
        (root / "report" / f"{name}.py").write_text(f"from jaxguide.report import {other}")
    assert sorted(circle(root)) == ["jaxguide.report.a", "jaxguide.report.b"]
