"""What a store is identified by: what decides its bits, and neither words nor other files."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false

import dataclasses
import importlib.util
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_sweep_store import DISPERSIONS, TILE, flown, mission

import jaxguide
import jaxguide as jg
from jaxguide.export import export
from jaxguide.report import write
from jaxguide.sweeping import identity, tally, tiles
from jaxguide.sweeping.histories import program_in_full
from jaxguide.sweeping.store import attributes_of, differences, open_store
from jaxguide.sweeping.sweep import again
from jaxguide.sweeping.syntax import syntax_of, without_docstrings

pytest.importorskip("zarr")
__all__ = ["mission"]  # a fixture

# A user's file: a plant with a base class, a law, and a disturbance that captures a number.
USER = """
import equinox as eqx
import jax
import jax.numpy as jnp

import jaxguide as jg
from jaxguide.laws.law import Command, Law

GRAVITY = 0.5


class Base(jg.Problem):
    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 0.0)

    def running_cost(self, t, x, u):
        return 0.5 * u[0] ** 2

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf - jnp.array([1.0, 0.0])

    def drag(self, v):
        return 0.25 * v


class Plant(Base):
    k: float = 1.0

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], 3.0 * self.k * u[0] - self.drag(x[1]) - GRAVITY])


class Feed(Command):
    du: jax.Array
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        return jnp.asarray(t)[None]

    def deviation(self, t):
        return self.du


class Proportional(Law):
    gain: float

    def start(self, x0):
        return None

    def __call__(self, t_k, x, memory):
        good = jg.RESULTS.where(jnp.array(True), jg.RESULTS.successful, jg.RESULTS.diverged)
        return Feed(self.gain * (1.0 - x[:1]), good, jnp.array(False)), memory


def push(force):
    return lambda t, x: jnp.stack([0.0 * x[0], force * t])


def mission():
    return jg.Mission(Plant(), Proportional(0.7), (0.0, 0.0), 0.25, disturbance=push(0.125))
"""
# As it might stand in another file of the user's, on lines that do not stand alone.
IN_A_CALL = """
CALLS = dict(
    first=lambda t: 2.0 * t,  # a comment
    second=lambda t: 3.0 * t)
"""
CHILD = """
import json, sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
import jaxguide as jg
import user
from jaxguide.sweeping.histories import program_in_full
from jaxguide.sweeping.identity import manifest
from jaxguide.sweeping.tiles import Order, Tiles
spread = {"initial_state": jg.Normal(0.02), "plant.k": jg.Uniform(-0.05, 0.05)}
order = Order(user.mission(), spread, 7, 100, 8, "sobol")
programs = Tiles(order).programs() | {"histories": program_in_full(order)}
print(json.dumps([jg.__file__, len(jax.devices()), manifest(order, programs)]))
"""


def manifest_of(mission):
    order = tiles.Order(mission, DISPERSIONS, 7, 100, TILE)
    return identity.manifest(order, tiles.Tiles(order).programs())


@pytest.fixture
def user(tmp_path, monkeypatch):
    """Imports a version of the user's file: `user(text, replacement, ...)`."""
    count = 0

    def load(*changes, source=USER):
        nonlocal count
        count += 1
        for old, new in zip(changes[::2], changes[1::2], strict=True):
            assert old in source
            source = source.replace(old, new)
        file = tmp_path / str(count) / "user.py"
        file.parent.mkdir()
        file.write_text(source)
        spec = importlib.util.spec_from_file_location("user", file)
        assert spec is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "user", module)
        assert spec.loader is not None
        spec.loader.exec_module(module)
        return module

    return load


# Words and other files change nothing -----------------------------------------------------------

WORDS = (
    "class Plant(Base):", 'class Plant(Base):\n    """A plant, now with a docstring."""\n',
    "    k: float = 1.0", '    k: float = 1.0  # [1/kg]\n    "Thrust per mass."',
    "    def drag(self, v):", '    def drag(self, v):\n        """Of air."""\n        # Linear.',
    "def push(force):", 'def push(force):\n    """A growing push."""',
    "return lambda t, x: jnp", "return lambda t, x:  jnp",
)  # fmt: skip


def test_a_docstring_in_a_plant_changes_nothing(user):
    plain = manifest_of(user().mission())
    assert manifest_of(user(*WORDS).mission()) == plain


@pytest.mark.slow
def test_words_in_the_package_change_nothing(user):
    """Another process, with another salt of its hashes and two devices, and a copy of the package
    that has a comment and a docstring more in every file, and another plot."""
    module = user()
    first = Path(module.__file__).parent
    second = Path(user(*WORDS).__file__).parent
    copy = second / "jaxguide"
    shutil.copytree(Path(jaxguide.__file__).parent, copy, ignore=lambda *_: ["__pycache__"])
    for file in copy.rglob("*.py"):
        lines = ["# A comment.", *file.read_text().splitlines()]
        if lines[1:] and lines[1].startswith('"""'):
            lines[1] = '"""Other words. ' + lines[1][3:]
        file.write_text("\n".join(lines))
    style = copy / "plotting" / "style.py"
    style.write_text(style.read_text() + "\nANOTHER = 1\n")

    found = []
    root = Path(jaxguide.__file__).parents[1]
    for folder, package, devices in ((first, root, 1), (second, second, 2)):
        flags = f"--xla_force_host_platform_device_count={devices}"
        more = {"PYTHONPATH": str(package), "PYTHONHASHSEED": str(devices), "XLA_FLAGS": flags}
        out = subprocess.run(
            [sys.executable, "-c", CHILD, str(folder)],
            env=os.environ | more, capture_output=True, text=True, cwd=folder,
        )  # fmt: skip
        assert out.returncode == 0, out.stderr
        file, count, manifest = json.loads(out.stdout)
        assert Path(file).parents[1] == package and count == devices
        assert set(manifest["programs"]) == {
            "prepare", "covariance", "points", "tile", "histories"
        }  # fmt: skip
        found.append(manifest)
    assert found[0] == found[1]
    # And what this process finds, under the suite's own settings.
    spread = {"initial_state": jg.Normal(0.02), "plant.k": jg.Uniform(-0.05, 0.05)}
    order = tiles.Order(module.mission(), spread, 7, 100, 8, "sobol")
    programs = tiles.Tiles(order).programs() | {"histories": program_in_full(order)}
    here = identity.manifest(order, programs)
    same = lambda m: {k: v for k, v in m.items() if k not in ("xla", "mission")}
    assert same(here) == same(found[0])


def test_sums_are_those_of_the_host_code(monkeypatch):
    sources = {module: inspect.getsource(module) for module in identity._SUMS}

    def digest(old="$^", new=""):  # nothing
        changed = {module: re.sub(old, new, text) for module, text in sources.items()}
        assert (changed == sources) == (old == "$^")
        monkeypatch.setattr(inspect, "getsource", lambda module: changed[module])
        return identity._digest_of_sums.__wrapped__()

    plain = digest()
    assert digest('"""(?=[A-Z(])', '"""Other words. ') == plain
    assert digest(r"def worst\(", "# Another comment.\n\n\ndef worst(") == plain
    assert digest("_BITS, _LOWEST, _OCTAVES = 12,", "_BITS, _LOWEST, _OCTAVES = 11,") != plain
    assert digest(r"deviations = deviations\[good\]", "deviations = deviations[~good]") != plain
    assert tally in sources and tiles.Tiles in sources


def test_syntax_is_the_source_without_words():
    source = 'def f(x):\n    """Doc."""\n    if x:  # why\n        "text"\n    return (x + 1)\n'
    assert without_docstrings(source) == "def f(x):\n    if x:\n    return x + 1"
    assert without_docstrings("y = 'text'") == "y = 'text'"  # no statement by itself
    with pytest.raises(SyntaxError):
        without_docstrings("lambda x: x, y=2)")


# What changes a bit is named --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("3.0 * self.k", "3.5 * self.k", {"mission: plant", "programs: tile"}),
        ("0.25 * v", "0.75 * v", {"mission: plant", "programs: tile"}),  # in the base class
        ("k: float = 1.0", "k: float = 1.5", {"mission: plant"}),
        ("self.gain * (1.0", "self.gain * (2.0", {"mission: law", "programs: tile"}),
        ("Proportional(0.7)", "Proportional(0.8)", {"mission: law"}),
        ("force * t])", "force * t * t])", {"mission: disturbance", "programs: tile"}),
        ("push(0.125)", "push(0.25)", {"mission: disturbance", "programs: tile"}),
        ("GRAVITY = 0.5", "GRAVITY = 0.75", {"programs: tile"}),  # no part of a class
        ("0.25, disturbance", "0.125, disturbance", {"mission: sample_interval",
         "mission: max_samples", "programs: tile"}),
    ],
)  # fmt: skip
def test_a_change_is_named(user, old, new, parts):
    was = manifest_of(user().mission())
    told = differences(manifest_of(user(old, new).mission()), was)
    named = {entry.partition(" (")[0] for entry in told.split("), ")}
    # The flight is part of the covariance's program too; sample times are prepared.
    assert parts <= named <= parts | {"programs: covariance", "programs: prepare"}, told


def test_lambdas_functions_and_objects(user):
    one = user(source=IN_A_CALL).CALLS
    other = user("3.0 * t", "4.0 * t", "a comment", "words", source=IN_A_CALL).CALLS
    assert identity.digest(one["first"]) == identity.digest(other["first"])
    assert identity.digest(one["second"]) != identity.digest(other["second"])
    assert syntax_of(one["second"]) == "lambda t: 3.0 * t"

    def recursive(n, step=1):
        return n and recursive(n - step)

    class Plain:
        def __init__(self, size):
            self.size = size

    digest = identity.digest
    assert digest(recursive) == digest(recursive)  # captures itself
    assert digest(Plain(1)) == digest(Plain(1)) != digest(Plain(2))  # whose repr is an address
    long = np.arange(5000.0)  # whose repr is cut short
    assert digest(Plain(long)) == digest(Plain(long.copy()))
    assert digest(Plain(long)) != digest(Plain(np.where(long == 2500, 0, long)))
    assert digest(jax.jit(recursive)) == digest(recursive)
    assert digest(jax.random.key(1)) != digest(jax.random.key(2))
    assert digest({"a", "b"}) == digest({"b", "a"}) != digest({"a"})


def test_another_program_is_refused(mission, tmp_path, monkeypatch):
    """The library's own equations, changed: no part of the mission differs, but what is flown."""
    flown(mission, store=tmp_path / "a")
    sound = tiles.miss_distance
    monkeypatch.setattr(tiles, "miss_distance", lambda *at: 2 * sound(*at))
    tiles._program.cache_clear()
    try:
        with pytest.raises(ValueError, match=r"another sweep: programs: tile \(\w+, now \w+\)\."):
            flown(mission, store=tmp_path / "a", resume=True)
    finally:
        tiles._program.cache_clear()


def test_the_type_a_mission_has_already_is_no_change(mission, tmp_path):
    flown(mission, store=tmp_path / "a", chunk=40)
    flown(mission, store=tmp_path / "a", chunk=40, dtype="float64", resume=True)
    with pytest.raises(ValueError, match=r"dtype \(float64, now float32\)"):
        flown(mission, store=tmp_path / "a", chunk=40, dtype="float32", resume=True)


# At no price ------------------------------------------------------------------------------------


def test_a_store_compiles_no_more_than_memory(mission, tmp_path, compilations):
    options = {"histories": 2}
    flown(mission, **options)
    before = compilations()
    flown(mission, store=tmp_path / "a", **options)
    flown(mission, store=tmp_path / "a", resume=True, **options)
    assert compilations() == before


def test_a_tile_is_traced_once(mission, tmp_path, monkeypatch):
    inner = eqx.debug.assert_max_traces(tiles._fly_tile, max_traces=1)
    monkeypatch.setattr(tiles, "_fly_tile", inner)
    spread = {"initial_state": jg.Normal(0.01)}
    for resume in (False, True):
        jg.sweep(mission, spread, 9, 0, tile=4, store=tmp_path / "a", resume=resume)


# Stores of an earlier version -------------------------------------------------------------------


def test_a_store_of_an_earlier_version(mission, tmp_path):
    """Its manifest has a digest of the package's files: it is refused on resume, and read."""
    store = tmp_path / "a"
    data = flown(mission, store=store, label="mine").load()
    described = store / "zarr.json"
    root = json.loads(described.read_text())
    manifest = root["attributes"]["sweep"]
    del manifest["programs"], manifest["sums"]
    manifest["jaxguide"] = "0123456789abcdef"
    manifest["mission"]["plant"] = "fedcba9876543210"  # of a source, not of its syntax
    described.write_text(json.dumps(root))

    words = r"another sweep: jaxguide \(0123\w+, now absent\).*plant.*programs: tile.*earlier jax"
    with pytest.raises(ValueError, match=words):
        flown(mission, store=store, label="mine", resume=True)
    with pytest.raises(ValueError, match="cannot be compared with this mission. An earlier jaxg"):
        again(attributes_of(store)["sweep"], mission, DISPERSIONS, store)

    assert write(store, tmp_path / "a.html").exists()
    assert export(store, tmp_path / "a.csv").read_text().count("\n") == 101
    assert jg.compare(open_store(store), data)["difference"] == 0.0


def test_a_case_again_names_changed_software(mission, tmp_path):
    store = tmp_path / "a"
    flown(mission, store=store, label="mine", failures=1)
    attributes = attributes_of(store)
    found = attributes["sweep"] | {"about": attributes["about"]}
    assert again(found, mission, {}, store)[1] == ""
    other = found | {"programs": found["programs"] | {"tile": "0" * 16}, "jax": "0.9.0"}
    note = again(other, mission, {}, store)[1]
    assert "jax (0.9.0, now " in note and "programs: tile (" in note
    heavier = dataclasses.replace(mission, initial_state=mission.initial_state + jnp.ones(2))
    with pytest.raises(ValueError, match=r"another mission: mission: initial_state \("):
        again(found, heavier, {}, store)
