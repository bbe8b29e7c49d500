"""Sweeps on disk, over devices and workers: the same bits however they were flown."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false

import dataclasses
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator

import jaxguide as jg
from jaxguide.sweeping.store import stored

zarr = pytest.importorskip("zarr")

CASES, TILE = 100, 8
DISPERSIONS = {"initial_state": jg.Normal(0.02), "plant.k": jg.Uniform(-0.05, 0.05)}


@pytest.fixture(scope="module")
def mission(double_integrator):
    gains = jg.gain_schedule(double_integrator, np.arange(10) / 10)
    law = jg.NeighboringOptimal(gains, scale=0.6)
    return jg.Mission(DoubleIntegrator(), law, (0.0, 0.0), 0.1)


@pytest.fixture(scope="module")
def whole(mission):
    return flown(mission)


def flown(mission, **options):
    return jg.sweep(mission, DISPERSIONS, **{"cases": CASES, "seed": 7, "tile": TILE, **options})


def assert_same(a, b):
    for name in a.variables:
        np.testing.assert_array_equal(a[name].values, b[name].values, err_msg=name)
    timed = ("rollouts_per_s", "compile_s")
    assert {k: v for k, v in a.attrs.items() if k not in timed} == {
        k: v for k, v in b.attrs.items() if k not in timed
    }


@pytest.mark.parametrize("chunk", [1, 24, 77, 1000])
def test_chunks_and_stores_change_no_bit(mission, whole, tmp_path, chunk):
    assert_same(whole, flown(mission, chunk=chunk))
    assert_same(whole, flown(mission, chunk=chunk, store=tmp_path / "a"))
    # Complete: nothing is flown again, and it reads the same.
    again = flown(mission, chunk=chunk, store=tmp_path / "a", resume=True)
    assert_same(whole, again)
    import xarray as xr

    opened = xr.open_zarr(tmp_path / "a", consolidated=False, chunks=None)
    np.testing.assert_array_equal(opened.final_state.values, whole.final_state.values)
    assert list(opened.state.values) == ["x", "v"]


def test_a_summary_has_the_same_statistics(mission, whole, tmp_path):
    for options in ({}, {"store": tmp_path / "s"}):
        summary = flown(mission, keep="summary", **options)
        assert list(summary.data_vars) == ["result"]
        assert summary.attrs["percentiles"] == whole.attrs["percentiles"]
        assert summary.attrs["sample_covariance"] == whole.attrs["sample_covariance"]


def test_damaged_chunks_are_flown_again(mission, whole, tmp_path):
    store = tmp_path / "a"
    flown(mission, chunk=16, store=store)
    cut, tampered, gone = (store / "final_state" / "c" / str(k) / "0" for k in (1, 2, 3))
    cut.write_bytes(cut.read_bytes()[:20])
    raw = bytearray(tampered.read_bytes())
    raw[len(raw) // 2] ^= 1
    tampered.write_bytes(raw)
    gone.unlink()
    (store / "final_state" / "c" / "left.partial").write_bytes(b"of a write that was killed")
    before = {p: p.stat().st_mtime_ns for p in (store / "final_state" / "c").rglob("0")}
    assert_same(whole, flown(mission, chunk=16, store=store, resume=True))
    after = {p: p.stat().st_mtime_ns for p in (store / "final_state" / "c").rglob("0")}
    again = {p for p in after if after[p] != before.get(p)}
    assert again == {cut, tampered, gone}  # and no other
    assert not list(store.rglob("*.partial"))


def test_other_sweeps_are_refused(mission, tmp_path):
    store = tmp_path / "a"
    flown(mission, store=store)
    heavier = dataclasses.replace(mission, plant=dataclasses.replace(mission.plant, k=1.5))

    class Other(DoubleIntegrator):
        pass

    other = dataclasses.replace(mission, plant=Other())
    capped = dataclasses.replace(mission, law=dataclasses.replace(mission.law, cap=1.0))
    for options, words in (
        ({"seed": 8}, r"made by another sweep: seed \(7, now 8\)"),
        ({"cases": 99}, r"cases \(100, now 99\)"),
        ({"keep": "summary"}, r"keep \(all, now summary\)"),
        ({"mission": heavier}, "mission: plant"),
        ({"mission": other}, "mission: plant"),
        ({"mission": capped}, "mission: law"),
    ):
        with pytest.raises(ValueError, match=words):
            flown(**{"mission": mission, "store": store, "resume": True, **options})
    with pytest.raises(ValueError, match="already holds this sweep"):
        flown(mission, store=store)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="holds files but no sweep"):
        flown(mission, store=tmp_path / "b")
    assert (tmp_path / "b" / "notes.txt").read_text() == "mine"


def test_one_stored_case(mission, whole, tmp_path):
    store = tmp_path / "a"
    flown(mission, store=store, chunk=16, label="mine")
    told, case = stored(store, 37)
    assert (told["label"], told["seed"], told["dtype"]) == ("mine", 7, "float64")
    np.testing.assert_array_equal(case["final_state"], whole.final_state.values[37])
    with pytest.raises(ValueError, match="case is 100; .* has 0 to 99"):
        stored(store, 100)
    with pytest.raises(ValueError, match="holds no sweep"):
        stored(tmp_path, 0)
    flown(mission, store=tmp_path / "b")
    with pytest.raises(ValueError, match="of no mission of the library; call jg.rerun"):
        stored(tmp_path / "b", 0)


def test_a_store_that_cannot_be_written(mission, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        flown(mission, store=tmp_path / "file" / "a")


@pytest.mark.slow
def test_an_unreachable_scheduler(mission):
    pytest.importorskip("distributed")
    with pytest.raises(ValueError, match="no Dask scheduler answers at 'tcp://127.0.0.1:9'"):
        flown(mission, scheduler="tcp://127.0.0.1:9")


CHILD = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, {tests!r})
import numpy as np
import jaxguide as jg
from test_sweep_store import DISPERSIONS, TILE
from conftest import DoubleIntegrator
gains = jg.gain_schedule(jg.solve(DoubleIntegrator()), np.arange(10) / 10)
law = jg.NeighboringOptimal(gains, scale=0.6)
mission = jg.Mission(DoubleIntegrator(), law, (0.0, 0.0), 0.1)
{work}
"""
INTO = "jg.sweep(mission, DISPERSIONS, 768, 7, tile=TILE, chunk=64, store=store, resume=True)"


def child(tmp_path, work):
    """A process that makes the mission ready and does `work`."""
    code = CHILD.format(tests=str(Path(__file__).parent), work=work)
    kept = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    kept |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, env=os.environ | kept, text=True
    )


def files(store):
    return {p.relative_to(store): p.read_bytes() for p in sorted(store.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_killed_at_any_instant(tmp_path):
    """What kill -9 leaves at 20 random instants, flown to the end: 20 stores of 20 are the whole's.

    A process that is stopped has on disk what it would leave if it were killed there: one process
    is stopped at each instant and its files are copied, and at the last it is killed."""
    whole, flown = tmp_path / "whole", tmp_path / "flown"
    running = child(tmp_path, "\n".join(f"store = {str(s)!r}; {INTO}" for s in (whole, flown)))
    places, chunks = random.Random(0), 12
    digests = flown / "partial" / "digest" / "c"
    stores = [flown]
    for first in sorted(places.randrange(chunks - 1) for _ in range(20)):
        while running.poll() is None and not (digests / str(first) / "0").exists():
            time.sleep(1e-3)
        time.sleep(places.uniform(0.0, 0.05))  # a chunk takes some 0.1 s
        running.send_signal(signal.SIGSTOP)
        _, status = os.waitpid(running.pid, os.WUNTRACED)
        assert os.WIFSTOPPED(status)  # before it ended
        stores.append(tmp_path / f"store{len(stores)}")
        shutil.copytree(flown, stores[-1])
        if len(stores) == 21:
            running.send_signal(signal.SIGKILL)
        running.send_signal(signal.SIGCONT)
    assert running.wait() == -signal.SIGKILL
    want = files(whole)
    assert len(list((whole / "partial" / "digest" / "c").iterdir())) == chunks
    left = [files(store) for store in stores]
    assert want not in left and left[0] == left[20]
    assert child(tmp_path, f"for store in {[str(s) for s in stores]}: {INTO}").wait() == 0
    for store in stores:
        assert files(store) == want, store


@pytest.mark.slow
def test_workers_one_of_which_is_killed(mission, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    alone = flown(mission, cases=2000)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        victim = next(iter(cluster.workers.values()))

        class Killer:
            def init(self):
                return None

            def step(self, state, progress):
                if progress > 0.4 and not hasattr(self, "done"):
                    self.done = True
                    os.kill(victim.pid, signal.SIGKILL)

            def close(self, state):
                pass

        options = {"cases": 2000, "chunk": 40, "scheduler": cluster.scheduler_address}
        killer = Killer()
        together = flown(mission, store=tmp_path / "a", progress=killer, **options)
        assert killer.done
    assert_same(alone, together)


@pytest.mark.slow
def test_two_devices_give_the_bits_of_one(tmp_path):
    code = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, {tests!r})
import numpy as np
import jaxguide as jg
from test_sweep_store import DISPERSIONS, TILE
from conftest import DoubleIntegrator
gains = jg.gain_schedule(jg.solve(DoubleIntegrator()), np.arange(10) / 10)
mission = jg.Mission(DoubleIntegrator(), jg.NeighboringOptimal(gains, scale=0.6), (0.0, 0.0), 0.1)
data = jg.sweep(mission, DISPERSIONS, 100, 7, tile=TILE)
print(len(jax.devices()))
np.save(sys.argv[1], data.final_state.values)
"""
    code = code.format(tests=str(Path(__file__).parent))
    ends = []
    for count in (1, 2):
        env = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={count}"}
        file = tmp_path / f"{count}.npy"
        out = subprocess.run(
            [sys.executable, "-c", code, str(file)], env=env, capture_output=True, text=True
        )
        assert out.returncode == 0, out.stderr
        assert int(out.stdout) == count
        ends.append(np.load(file))
    np.testing.assert_array_equal(*ends)
    assert jnp.all(jnp.isfinite(ends[0]))
