"""Evenly spread cases: the published points, true permutations, exact marginals, faster means."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOptionalMemberAccess=false

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc

import jaxguide as jg
from jaxguide.montecarlo.sampling import LatinHypercube, Sobol, directions, points

KEY = jax.random.key(3)


def many(spread_by, count, dtype=jnp.float64):
    return np.asarray(jax.jit(jax.vmap(lambda k: spread_by(k, dtype)))(jnp.arange(count)))


def test_unscrambled_points_are_scipys():
    plain = Sobol(jnp.asarray(directions(7)), jnp.zeros(7, jnp.uint32))
    got = many(plain, 256) - 2.0**-33  # the middles of intervals whose corners SciPy gives
    np.testing.assert_array_equal(got, qmc.Sobol(7, scramble=False, bits=32).random(256))


def test_scrambled_points_keep_their_even_spread():
    """Of 2^10 points, every interval of 2^-10 in each dimension has one: exact, unlike chance."""
    u = many(points("sobol", KEY, 5, 1024), 1024)
    for column in np.floor(u * 1024).T:
        np.testing.assert_array_equal(np.sort(column), np.arange(1024))
    plain = qmc.Sobol(5, scramble=False).random(1024)
    assert not np.any(np.isclose(u, plain, atol=1e-9).all(axis=1))
    # As even as SciPy's own scrambling, and far from a random sample's 1/sqrt(N) wander.
    ours, theirs = qmc.discrepancy(u), qmc.discrepancy(qmc.Sobol(5, rng=1).random(1024))
    chance = qmc.discrepancy(np.random.default_rng(0).random((1024, 5)))
    assert ours < 2 * theirs and ours < chance / 20


@pytest.mark.parametrize("cases", [1, 2, 3, 100, 1000])
def test_layers_are_permutations(cases):
    spread_by = points("latin_hypercube", KEY, 3, cases)
    layers = np.asarray(jax.jit(jax.vmap(spread_by.layer))(jnp.arange(cases)))
    for column in layers.T:
        np.testing.assert_array_equal(np.sort(column), np.arange(cases))
    u = many(spread_by, cases)
    np.testing.assert_array_equal(np.floor(u * cases), layers)
    if cases == 1000:
        # Dimensions are permuted unlike each other and unlike the order of cases: a correlation
        # of random permutations has the standard error 1/sqrt(N - 1).
        r = np.corrcoef(np.column_stack([np.arange(cases), layers]).T)
        assert np.abs(r - np.eye(4)).max() < 4 / np.sqrt(cases - 1)


def test_permutations_are_as_good_as_random():
    """Over many keys, each layer comes to case 0 equally often (chi square at 0.1 %)."""
    cases, trials = 23, 4600
    keys = jax.random.split(KEY, trials)
    layer = jax.jit(jax.vmap(lambda k: points("latin_hypercube", k, 1, cases).layer(0)[0]))
    counts = np.bincount(np.asarray(layer(keys)), minlength=cases)
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_points_never_touch_the_ends(dtype):
    """The extreme words of 32 bits, and the last layer of many."""
    ends = Sobol(jnp.zeros((32, 2), jnp.uint32), jnp.array([0, 2**32 - 1], jnp.uint32))
    last = LatinHypercube(KEY, jnp.ones((1, 2, 1), jnp.uint32), 2**24)
    for u in (many(ends, 1, dtype), many(last, 64, dtype)):
        assert u.dtype == dtype and np.all((u > 0) & (u < 1))
        assert np.all(np.isfinite(np.asarray(jax.scipy.special.ndtri(u))))


DISTRIBUTIONS = {
    "normal": (jg.Normal(2.0, mean=1.0), stats.norm(1.0, 2.0)),
    "uniform": (jg.Uniform(-1.0, 3.0), stats.uniform(-1.0, 4.0)),
    "truncated": (jg.TruncatedNormal(1.0, -0.5, 2.0), stats.truncnorm(-0.5, 2.0)),
    "tail": (jg.TruncatedNormal(1.0, 6.0, 9.0), stats.truncnorm(6.0, 9.0)),
    "log-normal": (jg.LogNormal(0.3), stats.lognorm(0.3, loc=-1.0)),
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_quantiles_are_scipys(name):
    ours, theirs = DISTRIBUTIONS[name]
    u = np.array([1e-9, 1e-3, 0.2, 0.5, 0.8, 0.999, 1 - 1e-9])
    # Condition of the inverse near 1: an error eps in u is eps/pdf in the quantile.
    want = theirs.ppf(u)
    allowed = 1e-11 * np.maximum(1, np.abs(want)) + 4e-16 / theirs.pdf(want)
    assert np.all(np.abs(np.asarray(ours.quantile(jnp.asarray(u))) - want) <= allowed)


def test_correlated_and_relative_quantiles():
    cov = np.array([[2.0, -0.6], [-0.6, 0.5]])
    u = many(points("sobol", KEY, 2, 4096), 4096)
    draws = np.asarray(jax.vmap(jg.MultivariateNormal(cov).quantile)(jnp.asarray(u)))
    np.testing.assert_allclose(np.cov(draws.T), cov, atol=5e-3)  # 10 times below random's 0.05
    leaf = jnp.asarray(3.0)
    half = jg.Relative(jg.Uniform(0.0, 1.0)).deviation(KEY, leaf, jnp.asarray(0.5))
    np.testing.assert_allclose(half, 1.5)


@pytest.mark.slow
def test_means_converge_faster_than_at_random():
    """A smooth function of four normals: E[exp(sum/4)] = e^(1/8), by 4,096 points, 8 seeds."""
    exact, count = np.exp(0.125), 4096

    def error(sampling):
        off = []
        for seed in range(8):
            spread_by = points(sampling, jax.random.key(seed), 4, count)
            u = jax.random.uniform(jax.random.key(seed), (count, 4))
            u = u if spread_by is None else jnp.asarray(many(spread_by, count))
            y = jnp.exp(jg.Normal(1.0).quantile(u).sum(axis=1) / 4)
            off.append(float(y.mean()) - exact)
        return np.sqrt(np.mean(np.square(off)))

    # In layers the additive part's variance is gone (of this function, 96 %); Sobol's points do
    # nearly N^-1.5 on smooth ones. A third and a tenth of random's error are safe by far.
    assert error("latin_hypercube") < error("random") / 3
    assert error("sobol") < error("random") / 10


def test_refuses():
    with pytest.raises(ValueError, match="sampling is 'halton'; choose one of random, latin"):
        points("halton", KEY, 2, 4)
    with pytest.raises(ValueError, match="2\\^32 points; 4294967297 cases are too many"):
        points("sobol", KEY, 2, 2**32 + 1)
