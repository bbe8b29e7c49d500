"""Compiled programs kept between processes: `jaxguide.host.executables` and its cache."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

import json
import os
import stat
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxguide import cli
from jaxguide.host import cache, executables
from jaxguide.host.compilation import quick_compilation
from jaxguide.host.executables import kept


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache. JAX's own, which CI sets, would be taken instead."""
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "programs"))
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


class Pair(eqx.Module):
    a: jax.Array
    b: jax.Array
    label: str = eqx.field(static=True)


def scaled(pair, by, shift=0.0):
    """Arrays, a number that is static, and a result that is no array."""
    return Pair(pair.a * by, pair.b + shift, pair.label), by


def pair():
    return Pair(jnp.arange(3.0), np.ones(2), "p")


def again():
    """A function whose programs this process has not made."""
    return kept(lambda *args, **kwargs: scaled(*args, **kwargs))


# As a process of its own: what is compiled, after the devices are up.
PROGRAM = """
import json, jax, numpy as np
jax.config.update("jax_enable_x64", True)
jax.devices()
from jaxguide.host.compilation import quick_compilation
from jaxguide.host.executables import kept
def f(x, k, key):
    return jax.numpy.cumsum(jax.numpy.sin(k * x)), jax.random.normal(key), np.float32
names = []
def listen(event, duration, **kwargs):
    if event == "/jax/core/compile/backend_compile_duration":
        names.append(kwargs["fun_name"])
jax.monitoring.register_event_duration_secs_listener(listen)
key = jax.device_put(jax.random.wrap_key_data(np.array([1, 2], np.uint32)))
out = kept(f)(np.arange(5.0), 2, key)
mine = [n for n in names if "(f)" in n]
print(json.dumps({"compiled": len(mine), "out": [np.asarray(a).tolist() for a in out[:2]]}))
"""


# A program of the package that calls LAPACK (QR, for gains by least squares), told without a trace.
WITH_LAPACK = """
import json, jax, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxguide.host.executables import kept
program, arguments = kept(jax.numpy.linalg.qr), (np.eye(3) + 1.0,)
known = program.is_kept(*arguments)
print(json.dumps({"known": known, "out": np.asarray(program(*arguments)[1]).tolist()}))
"""


def in_a_process(folder, program=PROGRAM, **environment):
    """What `program` printed, and its stderr."""
    given = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", "TF_CPP"))}
    given |= {cache.VARIABLE: str(folder), **environment}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
    return json.loads(done.stdout), done.stderr


def test_second_process_compiles_nothing(tmp_path):
    folder = tmp_path / "programs"
    first, _ = in_a_process(folder)
    second, noise = in_a_process(folder)
    assert first["compiled"] == 1 and second["compiled"] == 0
    assert first["out"] == second["out"]
    assert noise == ""  # XLA's loader warns of features that no machine has
    (entry,) = folder.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE(entry.stat().st_mode) == 0o600
    # Another option of XLA, another program.
    flags = "--xla_cpu_use_fusion_emitters=false"
    assert in_a_process(folder, XLA_FLAGS=flags)[0]["compiled"] == 1
    # JAX's own cache is left alone, and is left to work alone.
    own = in_a_process(tmp_path / "other", JAX_COMPILATION_CACHE_DIR=str(tmp_path / "jax"))[0]
    assert own["compiled"] == 1 and not (tmp_path / "other").exists()


def test_lapack_is_there_for_a_program_that_was_not_traced(tmp_path):
    first, second = (in_a_process(tmp_path / "programs", WITH_LAPACK)[0] for _ in range(2))
    assert (first["known"], second["known"]) == (False, True)
    assert first["out"] == second["out"]


def test_kept_again(folder, compilations):
    """From the file, with the structure, the types and the numbers of `eqx.filter_jit`."""
    want = eqx.filter_jit(scaled)(pair(), 2, shift=1.0)
    before = compilations()
    got = again()(pair(), 2, shift=1.0)
    assert compilations() == before + 1
    loaded = again()(pair(), 2, shift=1.0)
    assert compilations() == before + 1
    for found in (got, loaded):
        assert eqx.tree_equal(found, want)
        weak = [a.weak_type for a in jax.tree_util.tree_leaves(found) if eqx.is_array(a)]
        assert weak == [a.weak_type for a in jax.tree_util.tree_leaves(want) if eqx.is_array(a)]


def test_equal_numbers_of_other_types_are_others(folder):
    f = again()
    assert [type(f(pair(), by)[1]) for by in (1, 1.0)] == [int, float]


def test_unused_arguments_stay_apart(folder):
    """Their text is the same but for the argument that is used."""
    first, second = kept(lambda a, b: 2 * a), kept(lambda a, b: 2 * b)
    a, b = jnp.asarray(1.0), jnp.asarray(2.0)
    assert (first(a, b), second(a, b)) == (2.0, 4.0)


def test_large_constants_are_in_the_key(folder):
    numbers = np.random.default_rng(0).normal(size=(2, 10_000))
    got = [kept(lambda i, c=c: jnp.asarray(c)[i])(jnp.asarray(3)) for c in numbers]
    np.testing.assert_array_equal(got, numbers[:, 3])
    assert cache.state().entries == 2


@pytest.mark.parametrize("options", [None, quick_compilation])
def test_under_a_trace_it_is_the_function(folder, options):
    """Options of a compiler are for a program of its own: inside another they are refused."""
    f = kept(lambda x, k: jnp.sum(x**k), options)
    x = jnp.arange(1.0, 4.0)
    np.testing.assert_allclose(jax.grad(f)(x, 3), 3 * x**2, rtol=1e-15)
    np.testing.assert_array_equal(jax.vmap(lambda v: f(v, 3))(x[:, None]), x**3)
    np.testing.assert_array_equal(jax.jit(lambda v: f(v, 3))(x), jnp.sum(x**3))
    assert cache.state().entries == 0
    # A host call inside someone's trace.
    np.testing.assert_array_equal(jax.jit(lambda v: v * f(x, 3))(x), x * jnp.sum(x**3))


@pytest.mark.parametrize("damage", ["short", "flipped", "foreign", "other key", "not a program"])
def test_damaged_entry_is_made_anew(folder, compilations, damage):
    want = again()(pair(), 2)
    (entry,) = folder.iterdir()
    data = entry.read_bytes()
    if damage == "not a program":  # sound as a file
        cache.keep(entry.stem, b"no pickle")
    else:
        spoilt = {
            "short": data[:40],
            "flipped": data[:-9] + bytes([data[-9] ^ 1]) + data[-8:],
            "foreign": b"",
            "other key": data.replace(entry.stem.encode(), b"0" * 64),
        }
        entry.write_bytes(spoilt[damage])
    before = compilations()
    assert eqx.tree_equal(again()(pair(), 2), want)
    assert compilations() == before + 1
    assert eqx.tree_equal(again()(pair(), 2), want)
    assert compilations() == before + 1  # and kept again


@pytest.mark.parametrize("shared", ["folder", "file"])
def test_what_others_may_write_is_not_read(folder, compilations, shared):
    again()(pair(), 2)
    (entry,) = folder.iterdir()
    (folder if shared == "folder" else entry).chmod(0o777)
    before = compilations()
    again()(pair(), 2)
    assert compilations() == before + 1
    assert bool(cache.state().trouble) == (shared == "folder")


def test_links_are_not_followed(folder, tmp_path):
    again()(pair(), 2)
    (entry,) = folder.iterdir()
    entry.rename(tmp_path / "elsewhere")
    entry.symlink_to(tmp_path / "elsewhere")
    assert cache.read(entry.stem) is None
    folder.rename(tmp_path / "moved")
    folder.symlink_to(tmp_path / "moved")
    assert cache.read(entry.stem) is None


def test_off(folder, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, "")
    again()(pair(), 2)
    assert not folder.exists() and cache.state().folder is None


def test_a_folder_that_cannot_be_written(folder):
    folder.write_text("a file")
    assert again()(pair(), 2)[1] == 2


def test_other_versions_are_other_programs(folder, monkeypatch, compilations):
    again()(pair(), 2)
    monkeypatch.setattr(executables, "_here", lambda: ("another jaxlib",))
    before = compilations()
    again()(pair(), 2)
    assert compilations() == before + 1 and cache.state().entries == 2


def test_callbacks_are_not_kept(folder):
    double = lambda x: jax.pure_callback(lambda v: 2 * v, jax.ShapeDtypeStruct((), x.dtype), x)
    assert kept(double)(jnp.asarray(3.0)) == 6.0
    refuse = lambda x: eqx.error_if(x, x > 0, "too large")
    with pytest.raises(RuntimeError, match="too large"):
        kept(refuse)(jnp.asarray(3.0))
    assert cache.state().entries == 0


def test_the_longest_unused_go(folder, monkeypatch):
    for i, name in enumerate("abc"):
        cache.keep(name, os.urandom(1000))
        os.utime(folder / f"{name}.program", (i, i))
    assert cache.read("a") is not None  # used now
    monkeypatch.setattr(cache, "LIMIT", 3500)
    cache.keep("d", os.urandom(1000))
    assert {p.stem for p in folder.iterdir()} == {"a", "c", "d"}


def test_doctor_shows_and_clears(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    from jaxguide import doctor

    monkeypatch.setattr(doctor, "canary", lambda: 0)
    again()(pair(), 2)
    shown = doctor.check_installation()["programs kept"]
    assert shown["ok"] and "1 entries" in shown["value"] and str(folder) in shown["value"]
    cli.run(["doctor", "--clear-cache", "--json"])
    found = json.loads(capsys.readouterr().out)["checks"]["programs kept"]
    assert "0 entries" in found["value"] and list(folder.iterdir()) == []
    folder.chmod(0o777)
    assert not doctor.check_installation()["programs kept"]["ok"]
