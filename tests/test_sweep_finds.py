"""What a sweep finds and keeps beside its cases: rules to stop, importance, worst cases, flights in
full, the check of what was applied; and the same case again by evenly spread points."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

import dataclasses
import os
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator
from test_montecarlo import Cliff, closed_loop
from test_sweep_store import DISPERSIONS, TILE, assert_same, files, flown, mission, whole

import jaxguide as jg
from jaxguide.montecarlo.rollouts import case_key
from jaxguide.sweeping import importance, ranking, tiles
from jaxguide.sweeping.stopping import LOOK, fitting, rule

pytest.importorskip("zarr")
__all__ = ["mission", "whole"]  # fixtures

STD = np.array([0.02, 0.01])


# Evenly spread cases ---------------------------------------------------------------------------


@pytest.mark.parametrize("sampling", ["sobol", "latin_hypercube"])
@pytest.mark.slow
def test_evenly_spread_cases_are_the_same_anywhere(mission, sampling, tmp_path):
    """In chunks, alone, and in pure rollouts of the sweep's own keys."""
    once = flown(mission, sampling=sampling)
    assert_same(once, flown(mission, sampling=sampling, chunk=24, store=tmp_path / "a"))
    keys = jax.vmap(lambda k: case_key(7, k))(jnp.arange(100))
    pure = jax.jit(lambda k: jg.rollouts(mission, DISPERSIONS, k, sampling=sampling))(keys)
    np.testing.assert_allclose(pure.final_state, once.final_state.values, rtol=0, atol=1e-12)
    again = jg.rerun(mission, DISPERSIONS, 7, 41, sampling, 100)
    np.testing.assert_allclose(again.final_state, once.final_state.values[41], rtol=0, atol=1e-12)
    # One of 100 layers each, or near it: k is uniform on [-0.05, 0.05].
    layers = np.sort(np.floor((once["draw:plant.k"].values + 0.05) * 1000))
    if sampling == "latin_hypercube":
        np.testing.assert_array_equal(layers, np.arange(100))
        with pytest.raises(ValueError, match="depends on its number of cases; pass cases="):
            jg.rerun(mission, DISPERSIONS, 7, 41, sampling)
    with pytest.raises(ValueError, match=f"sampling \\({sampling}, now random\\)"):
        flown(mission, chunk=24, store=tmp_path / "a", resume=True)


# Rules that stop a sweep -----------------------------------------------------------------------

MANY = 20 * LOOK * TILE  # twenty looks


def test_a_rule_stops_at_the_same_case_however_flown(mission, tmp_path):
    stop = jg.PercentileWithin("x", 95.0, 1e-4)
    once = flown(mission, cases=MANY, stop=stop)
    flights, looks = once.attrs["flown"], LOOK * TILE
    assert flights % looks == 0 and looks < flights < MANY and once.sizes["case"] == flights
    options = {"cases": MANY, "stop": stop, "store": tmp_path / "a"}
    assert_same(once, flown(mission, chunk=1000, **options))
    assert_same(once, flown(mission, chunk=1000, resume=True, **options))
    for chunk in (TILE, 5 * TILE):
        assert_same(once, flown(mission, chunk=chunk, cases=MANY, stop=stop))
    # It is the first look at which the bounds are that narrow, by the cases themselves.
    plain = flown(mission, cases=flights)
    np.testing.assert_array_equal(plain.final_state.values, once.final_state.values)
    width = lambda data: np.subtract(*(data.attrs["percentiles"]["x"]["p95"][k] for k in HIGH_LOW))
    assert width(plain) <= 1e-4 < width(flown(mission, cases=flights - looks))


HIGH_LOW = ("high", "low")


def test_a_stopped_sweep_resumes_to_its_own_bits(mission, tmp_path):
    """Cut off before its end and damaged in between, it ends with the files of the whole one."""
    options = {"cases": MANY, "stop": jg.SuccessWithin(0.02), "chunk": 4 * TILE}
    flown(mission, store=tmp_path / "whole", **options)

    class Halt:
        init = close = lambda self, *a: None

        def step(self, state, progress):
            self.steps = getattr(self, "steps", 0) + 1
            if self.steps == 5:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        flown(mission, store=tmp_path / "cut", progress=Halt(), **options)
    (tmp_path / "cut" / "final_state" / "c" / "3" / "0").unlink()
    flown(mission, store=tmp_path / "cut", resume=True, **options)
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


def test_chunks_divide_the_looks():
    assert [fitting(k) for k in (1, 2, 3, 9, 16, 17, 1000)] == [1, 2, 4, 16, 16, 16, 16]


def test_rules_as_text_and_their_refusals(mission):
    assert rule("success:0.01") == jg.SuccessWithin(0.01)
    assert rule("miss:99:1e-6") == jg.PercentileWithin("miss", 99.0, 1e-6)
    for text in ("miss", "success:x", "miss:99", "miss:999:1"):
        with pytest.raises(ValueError, match=f"stop is '{text}'"):
            rule(text)
    with pytest.raises(ValueError, match="no quantity 'height'; there are x, v, miss"):
        flown(mission, stop=jg.PercentileWithin("height", 50.0, 1.0))
    with pytest.raises(ValueError, match="width is 0; give a number > 0"):
        jg.SuccessWithin(0)
    with pytest.raises(ValueError, match="takes no stop"):
        flown(mission, stop=jg.SuccessWithin(0.1), sampling="latin_hypercube")


# Importance and worst cases --------------------------------------------------------------------


def test_importance_of_a_linear_loop(mission):
    """x(tf) = F dx0: shares F_ij^2 s_j^2 / sum, by hand; sampled ones within their bounds."""
    data = jg.sweep(mission, {"initial_state": jg.Normal(STD)}, 16_384, 3, tile=1024)
    want = (closed_loop() * STD) ** 2
    want /= want.sum(axis=1, keepdims=True)
    for i, outcome in enumerate(("x", "v")):
        linear = data.attrs["linear_importance"][outcome]
        sampled = data.attrs["importance"][outcome]
        for j, name in enumerate(("initial_state[x]", "initial_state[v]")):
            np.testing.assert_allclose(linear[name], want[i, j], rtol=1e-6)
            share, half = sampled[name]
            assert half < 0.02
            # Bins lose up to 0.7 % of a share; twice the bounds for four numbers at once.
            assert abs(share - want[i, j]) <= 2 * half + 0.007


def test_first_order_indices_by_brute_force():
    """Ishigami's function against its closed form (Saltelli et al., 2000), through the sums."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-np.pi, np.pi, (200_000, 3))
    a, b = 7.0, 0.1
    y = np.sin(x[:, 0]) + a * np.sin(x[:, 1]) ** 2 + b * x[:, 2] ** 4 * np.sin(x[:, 0])
    v1, v2 = 0.5 * (1 + b * np.pi**4 / 5) ** 2, a**2 / 8
    variance = v1 + v2 + b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    off = y - y.mean()
    edges = importance.edges_of(x[:4096])
    sums = sum(
        importance.bin_sums(x[k : k + 8192], off[k : k + 8192, None], edges)
        for k in range(0, len(x), 8192)
    )
    found = importance.first_order(sums, np.array([y.var(ddof=1)]), np.ones(1))[:, 0]
    assert np.all(np.abs(found[:, 0] - np.array([v1, v2, 0]) / variance) <= 2 * found[:, 1] + 0.005)


def test_worst_cases(mission, whole):
    miss = whole.miss.values
    end = whole.final_state.values - [1.0, 0.0]
    np.testing.assert_allclose(miss, np.hypot(*end.T), rtol=1e-12)
    order = np.lexsort((np.arange(100), -miss))[: ranking.WORST]
    told = whole.attrs["worst"]
    assert [w["case"] for w in told] == order.tolist()
    np.testing.assert_array_equal([w["measure"] for w in told], miss[order])


def test_the_worst_do_not_depend_on_order():
    measure = np.random.default_rng(1).integers(0, 9, 500).astype(float)  # many are equal
    measure[7] = np.nan
    result = np.arange(500) % 3
    at_once = ranking.worst(measure, 0, result)
    parts = [ranking.worst(measure[k : k + 60], k, result[k : k + 60]) for k in range(0, 500, 60)]
    np.testing.assert_array_equal(ranking.merged(*parts[::-1]), at_once)
    np.testing.assert_array_equal(ranking.merged(ranking.merged(*parts[2:]), *parts[:2]), at_once)


# Flights in full -------------------------------------------------------------------------------


@pytest.mark.slow
def test_flights_in_full(mission, tmp_path):
    cliff = dataclasses.replace(mission, plant=Cliff())
    options = {"histories": 5, "failures": 4}
    data = flown(cliff, store=tmp_path / "a", chunk=16, **options)
    failed = np.flatnonzero(data.result.values != 0)
    kept = data.history_case.values
    assert set(kept) == {0, 1, 2, 3, 4, *failed[:4]} and len(kept) > 5
    np.testing.assert_array_equal(data.history_result.values, data.result.values[kept])
    ends = data.history_x.values[:, -1]
    np.testing.assert_allclose(ends, data.final_state.values[kept], rtol=0, atol=1e-12)
    alone = jg.rerun(cliff, DISPERSIONS, 7, int(kept[2]))
    np.testing.assert_allclose(data.history_u.values[2], alone.u, rtol=0, atol=1e-12)
    np.testing.assert_allclose(data.history_t.values[2], alone.t, rtol=0, atol=1e-12)
    # Wholly there on disk; damaged, they are flown again to the same bits, the cases are not.
    before = files(tmp_path / "a")
    (tmp_path / "a" / "histories" / "x" / "c" / "0" / "0" / "0").write_bytes(b"cut")
    flown(cliff, store=tmp_path / "a", chunk=16, resume=True, **options)
    assert files(tmp_path / "a") == before
    assert_same(data, flown(cliff, **options))
    with pytest.raises(ValueError, match="histories is -1; give 0 or more"):
        flown(cliff, histories=-1)


# What was applied ------------------------------------------------------------------------------


def test_what_was_applied_is_kept(mission, whole):
    np.testing.assert_array_equal(
        whole["applied:plant.k"].values, 1.0 + whole["draw:plant.k"].values
    )


def test_a_draw_that_is_not_applied_is_told(mission, monkeypatch):
    """A fault planted in the application of draws: k moves by its draw and a millionth more."""
    sound = tiles.with_deviations

    def faulty(mission, draws):
        return sound(mission, {k: v * (1 + 1e-6 * (k == "plant.k")) for k, v in draws.items()})

    monkeypatch.setattr(tiles, "with_deviations", faulty)
    tiles._program.cache_clear()
    try:
        with pytest.raises(RuntimeError, match="case 0 was flown with plant.k = .* but .* drawn"):
            flown(mission, tile=4)
    finally:
        tiles._program.cache_clear()


def test_laws_compared_see_the_same_draws(mission, whole):
    """Common random numbers: the same draws whatever flies, so that pairs differ by the law."""
    stronger = dataclasses.replace(mission, law=dataclasses.replace(mission.law, scale=0.8))
    other = flown(stronger)
    for name in ("draw:initial_state", "draw:plant.k"):
        np.testing.assert_array_equal(other[name].values, whole[name].values)
    told = jg.compare(whole, other)
    difference = other.miss.values - whole.miss.values
    half = 1.96 * difference.std(ddof=1) / 10
    np.testing.assert_allclose(told["difference"], difference.mean(), rtol=1e-12)
    np.testing.assert_allclose(told["high"] - told["difference"], half, rtol=1e-4)
    np.testing.assert_allclose(
        told["correlation"], np.corrcoef(whole.miss.values, other.miss.values)[0, 1], rtol=1e-10
    )
    assert told["high"] < 0 and told["lower"] > 0.5  # stronger gains, smaller misses
    assert told["unpaired"] > half
    with pytest.raises(ValueError, match="case 0 drew another initial_state"):
        jg.compare(whole, flown(mission, seed=8))
    with pytest.raises(ValueError, match="no 'miss' is kept of each case; there are none"):
        jg.compare(*[flown(mission, keep="summary")] * 2)


# A full disk -----------------------------------------------------------------------------------


def test_a_full_disk(mission, tmp_path):
    """A file system of 400 kB: a clean error, what was written kept, and gone on with when there
    is room."""
    small = tmp_path / "small"
    small.mkdir()
    if os.geteuid() != 0:
        pytest.skip("only root may mount a small file system")
    size = ["mount", "-t", "tmpfs", "-o", "size=400k"]
    if subprocess.run([*size, "tmpfs", str(small)], capture_output=True).returncode != 0:
        pytest.skip("this machine mounts no tmpfs")
    options = {"cases": 2000, "chunk": 40}
    try:
        with pytest.raises(OSError, match="(?s)No space left.*free some space.*--resume"):
            flown(mission, store=small / "a", **options)
        kept = len(list((small / "a" / "partial" / "digest" / "c").iterdir()))
        assert 0 < kept < 50
        grow = ["mount", "-o", "remount,size=40m", str(small)]
        assert subprocess.run(grow, capture_output=True).returncode == 0
        resumed = flown(mission, store=small / "a", resume=True, **options).load()
    finally:
        subprocess.run(["umount", str(small)], check=True)
    assert_same(flown(mission, **options), resumed)


@pytest.mark.slow
def test_a_plant_without_endpoint_constraints():
    """A plant without endpoint constraints has no miss; its worst are the furthest off."""

    class Free(DoubleIntegrator):
        def endpoint_constraints(self, x0, xf, t0, tf):
            return jnp.zeros((0,), xf.dtype)

    law = jg.OpenLoop(jg.solve(DoubleIntegrator(), jg.Shooting(arcs=2, segments=8, starts=4)))
    loop = jg.Mission(Free(), law, (0.0, 0.0), 0.1)
    data = jg.sweep(loop, {"initial_state": jg.Normal(STD)}, 50, 7, tile=TILE)
    assert "miss" not in data and set(data.attrs["percentiles"]) == {"x", "v"}
    size = np.sqrt(np.diag(data.attrs["linear_covariance"]))
    off = data.final_state.values - data.attrs["nominal_final_state"]
    assert data.attrs["worst"][0]["case"] == np.argmax(np.abs(off / size).max(axis=1))
