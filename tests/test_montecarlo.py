"""Dispersed flights: the same numbers one by one, in batches and in tiles; statistics of them."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportAssignmentType=false

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator
from scipy import stats

import jaxguide as jg
from jaxguide.montecarlo.rollouts import case_key, draw, with_deviations
from jaxguide.montecarlo.statistics import wilson_bounds
from jaxguide.sweeping import tiles as tiles_module
from jaxguide.sweeping.tally import BINS, Tally, count_in, tile_moments

STD = np.array([0.02, 0.01])
# Full gains held over a tenth bring the double integrator home exactly (the last two samples are
# deadbeat), which leaves nothing to compare.
SCALE = 0.6


@pytest.fixture(scope="module")
def mission(double_integrator):
    law = jg.NeighboringOptimal(
        jg.gain_schedule(double_integrator, np.arange(10) / 10), scale=SCALE
    )
    return jg.Mission(DoubleIntegrator(), law, (0.0, 0.0), 0.1)


DISPERSIONS = {"initial_state": jg.Normal(STD), "plant.k": jg.Uniform(-0.05, 0.05)}
TILE = 8


def closed_loop():
    """d final / d initial of the double integrator with du = K dx held over ten samples."""
    F = np.eye(2)
    for t in np.arange(10) / 10:
        K, h = SCALE * np.array([[-6 / (1 - t) ** 2, -4 / (1 - t)]]), 0.1
        F = (np.array([[1, h], [0, 1]]) + np.array([[h * h / 2], [h]]) @ K) @ F
    return F


# Rollouts -------------------------------------------------------------------------------------


def test_rollouts_are_the_single_flights(mission):
    keys = jax.random.split(jax.random.key(2), 4)
    flights = jax.jit(lambda k: jg.rollouts(mission, DISPERSIONS, k, save="samples"))(keys)
    assert flights.x.shape == (4, 11, 2) and flights.final_state.shape == (4, 2)
    one = eqx.filter_jit(jg.simulate)
    for i, key in enumerate(keys):
        k_draw, _ = jax.random.split(key)
        draws = draw(mission, DISPERSIONS, k_draw)
        alone = one(with_deviations(mission, draws))
        # Lanes are contracted differently from single flights: rounding times gains of 600.
        np.testing.assert_allclose(flights.x[i], alone.x, rtol=0, atol=1e-12)
        np.testing.assert_allclose(flights.x[i, 0], draws["initial_state"], rtol=1e-15)
        assert bool(alone.result == jg.RESULTS.successful)
    assert len(np.unique(np.asarray(flights.final_state)[:, 0])) == 4


def test_draws_reach_their_leaves(mission):
    draws = {"initial_state": jnp.array([0.5, 0.25]), "plant.k": jnp.asarray(0.1)}
    moved = with_deviations(mission, draws)
    np.testing.assert_array_equal(moved.initial_state, [0.5, 0.25])
    assert float(moved.plant.k) == 1.1 and float(mission.plant.k) == 1.0
    assert float(moved.law.schedule.extremal.problem.k) == 1.0  # the law's model stays


def test_another_dispersion_moves_no_other_draw(mission):
    key = jax.random.key(3)
    alone = draw(mission, {"initial_state": jg.Normal(STD)}, key)
    both = draw(mission, DISPERSIONS, key)
    np.testing.assert_array_equal(alone["initial_state"], both["initial_state"])


def test_rollouts_differentiate(mission):
    keys = jax.random.split(jax.random.key(4), 16)

    def spread(std):
        f = jg.rollouts(mission, {"initial_state": jg.Normal(std * jnp.asarray(STD))}, keys)
        return jnp.mean((f.final_state - jnp.array([[1.0, 0.0]])) ** 2)

    value, slope = jax.jit(jax.value_and_grad(spread))(jnp.asarray(1.0))
    # The loop is linear: the miss is proportional to std.
    np.testing.assert_allclose(slope, 2 * value, rtol=1e-6)
    ratio = jax.jit(jax.vmap(spread))(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(ratio[1] / ratio[0], 4.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("dispersions", "words"),
    [
        ({"plant.mass": jg.Normal(1.0)}, "no 'mass' in 'plant.mass'; there are .*k"),
        ({"initial_sate": jg.Normal(1.0)}, "did you mean 'initial_state'"),
        ({"plant": jg.Normal(1.0)}, "'plant' is not one array"),
        ({"sensor": jg.Normal(1.0)}, "'sensor' is not one array"),
        ({"max_samples": jg.Normal(1.0)}, "'max_samples' is not one array"),
        ({"plant.target.7": jg.Normal(1.0)}, "no '7'"),
        (
            {"initial_state": jg.Normal(np.ones(3))},
            r"std of shape \(3,\) does not fit a leaf of \(2,\)",
        ),
        ({"initial_state": jg.MultivariateNormal(np.eye(3))}, r"cov is \(3, 3\).*shape \(2,\)"),
    ],
)
def test_refuses_dispersions(mission, dispersions, words):
    for use in (
        lambda: jg.rollouts(mission, dispersions, jax.random.split(jax.random.key(0), 2)),
        lambda: jg.sweep(mission, dispersions, 2, 0),
    ):
        with pytest.raises(ValueError, match=words):
            use()


def test_refuses_distributions():
    with pytest.raises(ValueError, match="std is -1.0; give numbers >= 0"):
        jg.Normal(-1.0)
    with pytest.raises(ValueError, match="std is nan"):
        jg.Normal(np.nan)
    with pytest.raises(ValueError, match="TruncatedNormal: std is 0.0"):
        jg.TruncatedNormal(0.0, -1.0, 1.0)
    with pytest.raises(ValueError, match="lo=1.0 is not below hi=1.0"):
        jg.TruncatedNormal(1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="sigma is -0.1"):
        jg.LogNormal(-0.1)
    with pytest.raises(ValueError, match="lo=2.0 lies above hi=1.0; exchange"):
        jg.Uniform(2.0, 1.0)
    for cov, words in (
        (np.ones(3), "square and symmetric"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "square and symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "negative eigenvalue"),
    ):
        with pytest.raises(ValueError, match=words):
            jg.MultivariateNormal(cov)


@pytest.mark.parametrize(
    "distribution",
    [
        jg.Normal(STD, mean=np.array([1.0, -1.0])),
        jg.Uniform(np.array([-1.0, 0.0]), np.array([2.0, 0.5])),
        jg.MultivariateNormal(np.array([[2.0, -0.6], [-0.6, 0.5]]), mean=0.3),
        jg.MultivariateNormal(np.array([[1.0, 2.0], [2.0, 4.0]])),  # singular
        jg.TruncatedNormal(STD, -np.inf, 1.5 * STD),
        jg.TruncatedNormal(1.0, np.array([-0.5, 1.0]), 2.0, mean=0.5),
        jg.LogNormal(np.array([0.1, 0.3])),
    ],
    ids=["normal", "uniform", "multivariate", "singular", "cut", "cut twice", "log-normal"],
)
def test_moments_of_distributions(distribution):
    count = 20_000
    keys = jax.random.split(jax.random.key(0), count)
    draws = np.asarray(jax.vmap(lambda k: distribution.sample(k, (2,), jnp.float64))(keys))
    cov = np.asarray(distribution.covariance(2, jnp.float64))
    mean = expected(distribution)
    # Five standard errors: sqrt(var/N) of a mean, at most sqrt(2/N) sd_i sd_j of a covariance.
    sd = np.sqrt(np.diag(cov))
    assert np.all(np.abs(draws.mean(axis=0) - mean) <= 5 * sd / np.sqrt(count))
    # The tails of the log-normal add to the fourth moment: excess kurtosis below 2.
    allowed = 5 * np.sqrt(4 / count) * np.outer(sd, sd)
    assert np.all(np.abs(np.cov(draws.T) - cov) <= allowed)


def expected(distribution):
    """Mean by SciPy, or as given."""
    if isinstance(distribution, jg.Uniform):
        return (distribution.lo + distribution.hi) / 2
    if isinstance(distribution, jg.LogNormal):
        return np.exp(distribution.sigma**2 / 2) - 1
    if isinstance(distribution, jg.TruncatedNormal):
        m, s = distribution.mean, distribution.std
        a, b = (distribution.lo - m) / s, (distribution.hi - m) / s
        return stats.truncnorm.mean(a, b, loc=m, scale=s)
    return distribution.mean


def test_truncated_draws_stay_inside():
    cut = jg.TruncatedNormal(1.0, -0.5, 0.25)
    draws = cut.sample(jax.random.key(0), (1000,), jnp.float64)
    assert -0.5 <= draws.min() < -0.4 and 0.2 < draws.max() <= 0.25


def test_relative_draws_scale_with_their_leaf(mission):
    key = jax.random.key(5)
    mission = eqx.tree_at(lambda m: m.plant.k, mission, jnp.asarray(2.0))
    plain = draw(mission, {"plant.k": jg.LogNormal(0.1)}, key)["plant.k"]
    relative = draw(mission, {"plant.k": jg.Relative(jg.LogNormal(0.1))}, key)["plant.k"]
    np.testing.assert_allclose(relative, 2 * plain, rtol=1e-15)
    by = lambda d: jg.linear_covariance(mission, {"plant.k": d})[1]
    np.testing.assert_allclose(by(jg.Relative(jg.Normal(0.1))), by(jg.Normal(0.2)), rtol=1e-12)


def test_correlated_leaves(mission):
    """Two leaves drawn as one vector: perfectly correlated ones move together."""
    cov = np.array([[4.0, 0.0, 2.0], [0.0, 1.0, 0.0], [2.0, 0.0, 1.0]]) * 1e-4
    together = {("initial_state", "plant.k"): jg.MultivariateNormal(cov)}
    keys = jax.random.split(jax.random.key(0), 8)
    draws = jax.vmap(lambda k: draw(mission, together, k))(keys)
    np.testing.assert_allclose(draws["initial_state"][:, 0], 2 * draws["plant.k"], atol=1e-15)
    assert jg.rollouts(mission, together, keys).final_state.shape == (8, 2)
    # Uncorrelated, the same covariance is that of two dispersions.
    cov[0, 2] = cov[2, 0] = 0.0
    one = {("initial_state", "plant.k"): jg.MultivariateNormal(cov)}
    two = {"initial_state": jg.Normal(np.array([0.02, 0.01])), "plant.k": jg.Normal(0.01)}
    by = lambda d: jg.linear_covariance(mission, d)[1]
    np.testing.assert_allclose(by(one), by(two), rtol=1e-10)
    with pytest.raises(ValueError, match="'plant.k' is drawn twice"):
        draw(mission, one | {"plant.k": jg.Normal(0.1)}, keys[0])


def test_a_case_flown_again(mission, swept):
    again = jg.rerun(mission, DISPERSIONS, 7, 11)
    assert again.x.shape == (11, 2)
    np.testing.assert_allclose(again.final_state, swept.final_state.values[11], rtol=0, atol=1e-12)


# Sweeps ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swept(mission):
    return jg.sweep(mission, DISPERSIONS, 20, 7, tile=TILE)


def test_a_case_has_the_same_bits_in_any_sweep(mission, swept):
    for cases in (1, 8, 13):
        part = jg.sweep(mission, DISPERSIONS, cases, 7, tile=TILE)
        for name in ("final_state", "initial_state", "draw:plant.k", "result"):
            np.testing.assert_array_equal(part[name].values, swept[name].values[:cases])
    other = jg.sweep(mission, DISPERSIONS, 8, 8, tile=TILE)
    assert not np.any(other.final_state.values == swept.final_state.values[:8])


def test_a_sweep_is_its_rollouts(mission, swept):
    keys = jax.vmap(lambda k: case_key(7, k))(jnp.arange(20))
    flights = jax.jit(lambda k: jg.rollouts(mission, DISPERSIONS, k))(keys)
    np.testing.assert_allclose(flights.final_state, swept.final_state.values, rtol=0, atol=1e-12)


def test_stored_draws_are_the_deviations_applied(mission, swept):
    np.testing.assert_array_equal(swept["draw:initial_state"], swept.initial_state)  # nominal is 0
    k = swept["draw:plant.k"].values
    assert k.shape == (20,) and np.all(np.abs(k) <= 0.05)
    flown = eqx.tree_at(
        lambda m: (m.initial_state, m.plant.k),
        mission,
        (jnp.asarray(swept.initial_state.values[3]), jnp.asarray(1 + k[3])),
    )
    alone = eqx.filter_jit(jg.simulate)(flown)
    np.testing.assert_allclose(alone.final_state, swept.final_state.values[3], rtol=0, atol=1e-12)


def test_what_a_sweep_reports(swept):
    assert swept.final_state.sizes == {"case": 20, "state": 2}
    assert list(swept.state.values) == ["x", "v"]
    a = swept.attrs
    assert (a["cases"], a["seed"], a["failures"], a["success_rate"]) == (20, 7, {}, 1.0)
    assert a["success_rate_bounds"][1] == 1.0 and a["success_rate_bounds"][0] < 0.9
    finals = swept.final_state.values
    np.testing.assert_allclose(a["percentiles"]["x"]["mean"], finals[:, 0].mean(), rtol=1e-14)
    # Percentiles are good to 2^-12 of their distance from the undispersed flight.
    median, nominal = np.median(finals[:, 1]), a["nominal_final_state"][1]
    assert abs(a["percentiles"]["v"]["p50"]["value"] - median) <= 2**-12 * abs(median - nominal)
    np.testing.assert_allclose(a["sample_covariance"], np.cov(finals.T), rtol=1e-12)


def test_a_second_sweep_compiles_nothing(mission, swept, compilations):
    before = compilations()
    jg.sweep(mission, DISPERSIONS, 16, 11, tile=TILE)
    assert compilations() == before


def test_the_compiled_tile_traces_once(mission, monkeypatch):
    inner = eqx.debug.assert_max_traces(tiles_module._fly_tile, max_traces=1)
    monkeypatch.setattr(tiles_module, "_fly_tile", inner)
    jg.sweep(mission, {"initial_state": jg.Normal(0.01)}, 9, 0, tile=4)  # three tiles


def test_a_sweep_with_a_disturbance_given_as_a_function(mission):
    pushed = dataclasses.replace(mission, disturbance=lambda t, x: jnp.array([0.0, 0.5]))
    still, moved = (jg.sweep(m, DISPERSIONS, 2, 7, tile=2) for m in (mission, pushed))
    # The same draws, another end; and the end that the pure rollouts reach with the same push.
    np.testing.assert_array_equal(moved["draw:plant.k"].values, still["draw:plant.k"].values)
    assert np.all(np.abs(moved.final_state.values - still.final_state.values).max(1) > 1e-2)
    keys = jax.vmap(lambda k: case_key(7, k))(jnp.arange(2))
    alone = eqx.filter_jit(jg.rollouts)(pushed, DISPERSIONS, keys)
    # Another program may round a lane differently, a few units in the last place a step.
    np.testing.assert_allclose(moved.final_state.values, alone.final_state, rtol=0, atol=1e-12)


class Cliff(DoubleIntegrator):
    """Leaves finite numbers at once where k is below 1."""

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0] / jnp.where(self.k < 1, 0.0, 1.0)])


def test_failures_are_rows(mission):
    cliff = dataclasses.replace(mission, plant=Cliff())
    data = jg.sweep(cliff, DISPERSIONS, 20, 7, tile=TILE)
    over = data["draw:plant.k"].values < 0
    assert 0 < over.sum() < 20
    np.testing.assert_array_equal(data.result.values != 0, over)
    assert data.attrs["failures"] == {"diverged": int(over.sum())}
    assert data.attrs["success_rate"] == 1 - over.mean()
    # The others fly as if alone, and the statistics are of them.
    assert np.all(np.isfinite(data.final_state.values))
    np.testing.assert_allclose(
        data.attrs["percentiles"]["x"]["mean"], data.final_state.values[~over, 0].mean(), rtol=1e-13
    )
    keys = jax.vmap(lambda k: case_key(7, k))(jnp.arange(20))
    flights = jax.jit(lambda k: jg.rollouts(cliff, DISPERSIONS, k))(keys)
    np.testing.assert_array_equal(flights.result._value, data.result.values)


def test_a_sweep_in_float32(mission):
    data = jg.sweep(mission, DISPERSIONS, 4, 7, tile=TILE, dtype="float32")
    assert data.final_state.dtype == np.float32 and data.attrs["dtype"] == "float32"
    assert np.all(data.result.values == 0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"cases": 0}, "cases is 0"),
        ({"tile": 0}, "tile is 0"),
        ({"chunk": 0}, "chunk is 0"),
        ({"resume": True}, "resume needs the store"),
        ({"keep": "most"}, "keep is 'most'; choose one of all, summary"),
        ({"cases": 10**9}, "GB in memory; give a store"),
        ({"dtype": "float16"}, "dtype is 'float16'"),
    ],
)
def test_sweep_refuses(mission, options, words):
    with pytest.raises(ValueError, match=words):
        jg.sweep(mission, DISPERSIONS, **{"cases": 4, "seed": 0, **options})


# Linear covariance ----------------------------------------------------------------------------


def test_linear_covariance_by_hand(mission):
    centre, P = jg.linear_covariance(mission, {"initial_state": jg.Normal(STD)})
    F = closed_loop()
    np.testing.assert_allclose(centre, [1, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(P, F @ np.diag(STD**2) @ F.T, rtol=1e-6)
    assert np.abs(F).max() > 0.01
    both = jg.linear_covariance(mission, DISPERSIONS)[1]
    only_k = jg.linear_covariance(mission, {"plant.k": jg.Uniform(-0.05, 0.05)})[1]
    np.testing.assert_allclose(both, P + only_k, rtol=1e-10)  # independent: variances add


def test_linear_covariance_against_a_sample(mission):
    count = 4096
    data = jg.sweep(mission, {"initial_state": jg.Normal(STD)}, count, 1, tile=1024)
    P, sampled = (np.array(data.attrs[k]) for k in ("linear_covariance", "sample_covariance"))
    # The loop is linear, so all that differs is sampling: a covariance has the standard error
    # sqrt((P_ij^2 + P_ii P_jj)/(N - 1)).
    d = np.diag(P)
    assert np.all(np.abs(sampled - P) <= 4 * np.sqrt((P**2 + np.outer(d, d)) / (count - 1)))
    mean = data.final_state.values.mean(axis=0)
    assert np.all(np.abs(mean - [1, 0]) <= 4 * np.sqrt(d / count) + 1e-9)


# Statistics -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("k", "n", "want"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, (0.2553, 0.3662)),
        (15, 148, (0.0624, 0.1605)),
        (0, 20, (0.0000, 0.1611)),
        (1, 29, (0.0061, 0.1718)),
    ],
)
def test_wilson_bounds_as_published(k, n, want):
    np.testing.assert_allclose(wilson_bounds(k, n), want, rtol=0, atol=5e-5)  # four digits printed


def test_wilson_bounds_at_the_edges():
    assert wilson_bounds(0, 0) == (0.0, 1.0)
    low, high = wilson_bounds(50, 50)
    assert high == 1.0 and 0.9 < low < 1
    np.testing.assert_allclose(wilson_bounds(0, 50)[1], 1 - low, rtol=1e-12)


def tallied(values, tile=None):
    """A Tally of the rows of `values`, in tiles."""
    centre, scale = np.full(values.shape[1], 0.25), np.full(values.shape[1], 2.0)
    histogram = np.zeros((values.shape[1], BINS), np.int64)
    tiles = np.split(values - centre, range(tile, len(values), tile)) if tile else [values - centre]
    for part in tiles:
        count_in(histogram, part / scale)
    return Tally(centre, scale, np.array([tile_moments(part) for part in tiles]), histogram)


@pytest.mark.parametrize("count", [100, 1000, 10_000])
@pytest.mark.parametrize("percent", [1.0, 5.0, 50.0, 95.0, 99.0])
def test_percentile_bounds_cover_as_often_as_they_say(count, percent):
    """Exactly, by the binomial law: the number below the quantile is binomial (N, p).

    A rank beyond the sample has no bound: it must be infinite, not the extreme of the sample.
    """
    # Ten octaves: each value has a bin to itself, from which its rank is read.
    per_octave = count / 10
    values = 0.25 + 2 ** (np.arange(1, count + 1) / per_octave)
    ranks = tallied(values[:, None]).percentile(0, percent)
    rank = lambda name: round(float(np.log2(ranks[name] - 0.25) * per_octave))
    below = stats.binom(count, percent / 100)
    # low <= quantile < high  when  low's rank <= number below < high's rank
    low = -1 if np.isinf(ranks["low"]) else rank("low")
    high = count + 1 if np.isinf(ranks["high"]) else rank("high")
    assert below.cdf(high - 1) - below.cdf(low - 1) >= 0.95 - 0.005  # normal approximation
    assert ranks["low"] <= ranks["value"] <= ranks["high"]


def test_statistics_from_sums():
    values = np.random.default_rng(0).normal(size=(501, 2))
    got = tallied(values, tile=100)
    summary = got.summary(("a", "b"))
    np.testing.assert_allclose(got.covariance, np.cov(values.T), rtol=1e-13)
    np.testing.assert_allclose(summary["b"]["mean"], values[:, 1].mean(), rtol=1e-12)
    np.testing.assert_allclose(summary["b"]["std"], values[:, 1].std(ddof=1), rtol=1e-13)
    for percent in (1, 5, 50, 95, 99):
        exact = np.quantile(values[:, 0], percent / 100)
        # A bin is 2^-12 of a value's distance from the centre wide.
        assert abs(summary["a"][f"p{percent}"]["value"] - exact) <= abs(exact - 0.25) * 2**-12
    assert tallied(values[:0]).summary(("a", "b")) == {}
    assert tallied(values[:1]).summary(("a", "b"))["a"]["std"] == 0.0
