"""Tuning by gradient: against closed forms, finite differences and exhaustive search."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalCall=false

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from conftest import DoubleIntegrator
from jax.test_util import check_grads
from scipy.integrate import quad
from scipy.stats import mstats

import jaxguide as jg
from jaxguide import problems, tuning
from jaxguide.laws.law import Command, Law
from jaxguide.montecarlo.rollouts import case_key
from jaxguide.spectral import legendre_coefficients, legendre_vandermonde, nodes_lg
from jaxguide.tuning.relaxation import thinned_weights

START = {"initial_state": jg.Normal(0.1), "plant.k": jg.Normal(0.2)}


def keys(cases, seed=0):
    return jax.vmap(lambda k: case_key(seed, k))(jnp.arange(cases))


# A closed loop in closed form: the double integrator from rest over unit distance and time -----


def nominal(t):
    return jnp.stack([3 * t**2 - 2 * t**3, 6 * t - 6 * t**2])


class Told(Command):
    u: jax.Array
    du: jax.Array
    result: jg.RESULTS
    saturated: jax.Array

    def nominal(self, t):
        return (6 - 12 * jnp.asarray(t))[None]

    def deviation(self, t):
        return self.du


class Gained(Law):
    """du = K(t) dx, K what `gain` says."""

    gain: eqx.Module

    def start(self, x0):
        return None

    def __call__(self, t_k, x, memory):
        du = self.gain(t_k) @ (x - nominal(t_k))
        result = jg.RESULTS.where(jnp.array(True), jg.RESULTS.successful, jg.RESULTS.diverged)
        return Told(u=du, du=du[None], result=result, saturated=jnp.array(False)), None


class Exact(eqx.Module):
    def __call__(self, t):
        left = 1 - t
        return jnp.stack([-6 / left**2, -4 / left])


class Table(eqx.Module):
    """Gains stored times the time to go, linear between those that are there."""

    places: jax.Array
    present: jax.Array

    def __call__(self, t):
        stored = jax.vmap(Exact())(self.places) * (1 - self.places)[:, None]
        t = jnp.minimum(t, self.places[-1])
        return thinned_weights(self.places, self.present, t) @ stored / (1 - t)


class Series(eqx.Module):
    """The gains' Legendre series over [0, END], each mode in part."""

    share: jax.Array

    def __call__(self, t):
        tau = nodes_lg(24)[0]
        a = legendre_coefficients(tau, jax.vmap(Exact())(END * (jnp.asarray(tau) + 1) / 2))
        P = legendre_vandermonde((2 * t / END - 1)[None], self.share.shape[0])[0]
        return (P * self.share) @ a[: self.share.shape[0]]


EVEN = jnp.full(10, 0.1)
END = 0.95  # where the last gain is stored


def loop(gain, lengths):
    plant = DoubleIntegrator()
    return jg.Mission(plant, Gained(gain), jnp.zeros(2), lengths, integrator=jg.RungeKutta4(1))


flown = tuning.Flown(START, chunk=16)


def objective(price):
    def of(built, keys):
        mission, count = built
        return jnp.log(jnp.mean(flown(mission, keys) ** 2)) + price * count, {"count": count}

    return of


def off_exact(price):
    """By how much stored gains miss the command of the exact ones, where these fly, and what they
    cost."""
    states = tuning.Flown(START, lambda mission, flight: flight.x[:-1], "samples", 16)
    times = jnp.arange(20) / 20

    def of(built, keys):
        gain, count = built
        x = states(loop(Exact(), jnp.full(20, 1 / 20)), keys)
        dx = x - jax.vmap(nominal)(times)[None]
        off = jnp.einsum("kn,bkn->bk", jax.vmap(gain)(times) - jax.vmap(Exact())(times), dx)
        return jnp.log(jnp.mean(off**2)) + price * count, {"count": count}

    return of


def off_in_the_mean(price):
    """By how much a series misses the gain of the position, squared, relative and averaged."""
    tau, w = (jnp.asarray(a) for a in nodes_lg(24))
    exact = jax.vmap(Exact())(END * (tau + 1) / 2)[:, 0]

    def of(built, keys):
        gain, count = built
        off = jax.vmap(gain)(END * (tau + 1) / 2)[:, 0] - exact
        return w @ off**2 / (w @ exact**2) + price * count, {"count": count}

    return of


# Each kind of count: build(design, temperature), its start, the true mission of an integer (or of
# a choice), and the integers there are.


def samples(design, temperature=None):
    count = design["count"]
    return loop(Exact(), tuning.sample_lengths(jnp.minimum(count, 16.0), 16, 1.0)), count


def modes(design, temperature):
    share = tuning.cutoff(design["count"], 12, temperature)
    return Series(share), tuning.priced(share)


PLACES = jnp.linspace(0.0, END, 7)


def stations(design, temperature):
    present = jnp.pad(tuning.occupancy(design["there"], temperature), 1, constant_values=1.0)
    return Table(PLACES, present), tuning.priced(present)


@pytest.mark.slow
def test_sample_count_against_all_integers():
    """More samples miss less and cost more: the count found is the best of all, or next to it."""
    of = objective(0.2)
    start = {"count": tuning.Bounded(12.0, 1.0)}
    tuned = tuning.tune(of, start, samples, optax.adam(0.05), steps=80, cases=32)
    value = jax.jit(lambda n: of(samples({"count": n}), keys(32))[0])
    every = tuning.exhaustive(lambda n: value(jnp.asarray(float(n))), range(1, 17))
    best = min(every, key=every.get)
    assert 2 < best < 12
    found = tuning.counted(lambda n: every[n], tuned.design["count"], tuned.loss, 1, 16)
    assert abs(found.count - best) <= 1
    # A relaxed count that is an integer is that integer's own mission.
    alone = loop(Exact(), jnp.full(best, 1 / best))
    own = of((alone, jnp.asarray(float(best))), keys(32))[0]
    assert float(own) == pytest.approx(every[best], abs=1e-9)
    assert tuning.gain_evaluations(alone) == best


def test_mode_count_against_all_integers():
    of, steps = off_in_the_mean(0.02), 60
    heat = tuning.cooling(1.0, 0.05, steps)
    start = {"count": tuning.Bounded(11.0, 1.0, 13.0)}
    tuned = tuning.tune(of, start, modes, optax.adam(0.1), steps=steps, cases=32, temperature=heat)
    cold = jnp.asarray(1e-3)
    value = jax.jit(lambda n: of(modes({"count": n}, cold), keys(32))[0])
    every = tuning.exhaustive(lambda n: value(jnp.asarray(float(n))), range(1, 13))
    best = min(every, key=every.get)
    assert 1 < best < 11
    found = tuning.counted(lambda n: every[n], tuned.design["count"], tuned.loss, 1, 12)
    assert abs(found.count - best) <= 1


def test_station_count_against_all_subsets():
    of, steps = off_exact(0.8), 100
    heat = tuning.cooling(1.0, 0.05, steps)
    start = {"there": jnp.full(5, 1.0)}
    tuned = tuning.tune(
        of, start, stations, optax.adam(0.1), steps=steps, cases=32, temperature=heat
    )
    value = jax.jit(lambda there: of(stations({"there": there}, jnp.asarray(1.0)), keys(32))[0])
    hard = lambda choice: value(80.0 * jnp.asarray(choice, float) - 40.0)
    every = {c: float(hard(c)) for c in itertools.product((0, 1), repeat=5)}
    best = min(every, key=every.get)
    chosen = tuple(int(v > 0) for v in tuned.design["there"])
    assert 0 < sum(best) < 5
    assert abs(sum(chosen) - sum(best)) <= 1
    assert tuned.loss == pytest.approx(every[chosen], abs=1e-2)  # cooled: relaxed is true


# Relaxations ------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [5.0, 5.3, 8.0])
def test_sample_lengths(count):
    shape = np.array([0.5, -0.3, 0.2])
    lengths = np.asarray(tuning.sample_lengths(count, 8, 3.0, jnp.asarray(shape)))
    slope = lambda s: np.exp(np.polynomial.legendre.legval(2 * s - 1, [0.0, *shape]))
    to_go = [
        3 * quad(slope, 0, s)[0] / quad(slope, 0, 1)[0] for s in np.minimum(np.arange(9) / count, 1)
    ]
    np.testing.assert_allclose(np.cumsum(lengths[::-1]), to_go[1:], atol=1e-13)
    assert np.sum(lengths > 0) == np.ceil(count)
    even = tuning.sample_lengths(count, 8, 3.0)
    np.testing.assert_allclose(even[-5:], np.full(5, 3 / count), rtol=1e-14)


def test_a_new_sample_enters_without_a_jump():
    value = jax.jit(lambda n: objective(0.0)(samples({"count": n}), keys(32))[0])
    at = lambda n: float(value(jnp.asarray(n)))
    slope = abs(at(6.25) - at(6.0)) / 0.25
    # Continuous with slopes of the same size on both sides; a jump would not shrink with the step.
    for step in (1e-3, 1e-6):
        for side in (-1, 1):
            assert abs(at(6 + side * step) - at(6.0)) <= 20 * slope * step + 1e-12


def test_thinned_weights_against_enumeration():
    places, present = jnp.array([0.0, 0.2, 0.5, 0.7, 1.0]), jnp.array([1.0, 0.3, 0.6, 0.9, 1.0])
    for t in (-0.1, 0.0, 0.3, 0.7, 0.95, 1.2):
        want = np.zeros(5)
        for choice in itertools.product((0, 1), repeat=3):
            there = np.flatnonzero([1, *choice, 1])
            chance = np.prod([p if c else 1 - p for c, p in zip(choice, present[1:4], strict=True)])
            x = np.asarray(places)[there]
            i = int(np.clip(np.searchsorted(x, t, side="right") - 1, 0, len(x) - 2))
            share = (t - x[i]) / (x[i + 1] - x[i])
            want[there[i]] += chance * (1 - share)
            want[there[i + 1]] += chance * share
        np.testing.assert_allclose(thinned_weights(places, present, t), want, atol=1e-15)


# Risk ---------------------------------------------------------------------------------------------


def test_risk():
    v = jnp.asarray(np.random.default_rng(0).normal(size=101))
    ordered = np.sort(v)
    # The definition, minimised over the cases themselves, where its minimum lies.
    for level in (0.5, 0.9, 0.955, 0.999):
        least = min(a + np.mean(np.maximum(ordered - a, 0)) / (1 - level) for a in ordered)
        assert float(tuning.cvar(v, level)) == pytest.approx(least, rel=1e-14)
        # A mean of the tail: its derivatives are weights, none below the quantile.
        slope = jax.grad(lambda v: tuning.cvar(v, level))(v)
        assert float(jnp.sum(slope)) == pytest.approx(1.0, abs=1e-12)
        check_grads(lambda v: tuning.cvar(v, level), (v,), order=1, modes=["rev"], rtol=1e-6)
    known = mstats.hdquantiles(np.asarray(v), [0.9])[0]
    assert float(tuning.smooth_quantile(v, 0.9)) == pytest.approx(known, rel=1e-12)
    check_grads(lambda v: tuning.smooth_quantile(v, 0.9), (v,), order=1, modes=["rev"], rtol=1e-6)
    assert float(tuning.quantile(v, 0.9)) == pytest.approx(np.quantile(v, 0.9), rel=1e-14)
    assert float(tuning.above(3.0, 2.0)) == 0.25 and float(tuning.above(1.0, 2.0)) == 0
    for f in (tuning.cvar, tuning.quantile, tuning.smooth_quantile):
        with pytest.raises(ValueError, match="level is 99.0; give a fraction"):
            f(v, 99.0)
    # Of many samples of 1,000, some 95 % have the true quantile between their bounds.
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(400):
        low, _, high = tuning.quantile_bounds(rng.uniform(size=1000), 0.99)
        inside += low <= 0.99 <= high
    assert 0.92 <= inside / 400 <= 0.99


# Flights ------------------------------------------------------------------------------------------


def test_lengths_of_samples():
    """Even lengths are the interval; their derivative is that of what they are; zeros are none."""
    make = lambda interval: jg.Mission(
        DoubleIntegrator(k=1.1), Gained(Exact()), jnp.array([0.05, -0.02]), interval
    )
    end = eqx.filter_jit(lambda lengths: jg.simulate(make(lengths), None, "ends").final_state)
    even = jnp.full(8, 1 / 8)
    whole = jg.simulate(make(1 / 8), None, "ends").final_state
    np.testing.assert_allclose(end(even), whole, atol=1e-13)
    padded = jnp.concatenate([jnp.zeros(3), even])
    np.testing.assert_allclose(end(padded), whole, atol=1e-13)
    uneven = jnp.array([0.2, 0.1, 0.15, 0.05, 0.15, 0.1, 0.15, 0.1])
    check_grads(lambda d: end(d / jnp.sum(d)), (uneven,), order=1, modes=["rev"], rtol=1e-6)
    for lengths, words in (
        ([0.5, 0.6], "adds up to 1.1, but the horizon is 1.0"),
        ([1.5, -0.5], r"sample_interval\[1\] is -0.5"),
        ([np.nan, 1.0], r"sample_interval\[0\] is nan"),
        ([[0.5, 0.5]], r"shape \(1, 2\)"),
    ):
        with pytest.raises(ValueError, match=words):
            make(jnp.asarray(lengths))


def test_flown_cases_are_those_of_a_sweep():
    mission = loop(Exact(), EVEN)
    found = jg.sweep(mission, START, 20, 3, tile=32)
    missed = flown(mission, keys(20, 3))
    off = found.final_state.values - np.array([1.0, 0.0])
    np.testing.assert_allclose(missed, np.linalg.norm(off, axis=1), atol=1e-13)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_cases():
    """Reverse mode keeps a chunk's flights, and of each case its key and its miss."""

    def bytes_of(cases, chunk):
        fly = tuning.Flown(START, chunk=chunk)
        loss = lambda lengths: jnp.mean(fly(loop(Exact(), lengths), keys(cases)))
        program = jax.jit(jax.grad(loss)).lower(EVEN).compile()
        told = program.memory_analysis()
        assert told is not None
        return told.temp_size_in_bytes

    small, large = bytes_of(64, 16), bytes_of(4096, 16)
    assert (large - small) / (4096 - 64) < 100  # bytes a case: keys, random bits, a miss
    assert bytes_of(4096, 4096) > 3 * large


# The loop -----------------------------------------------------------------------------------------


def bowl(built, keys):
    return jnp.sum((built["a"] - 2) ** 2), {"a": built["a"]}


def test_compiled_once(compilations, tmp_path):
    start = {"a": tuning.Bounded(0.5, 0.0, 3.0)}
    bare = tuning.tune(bowl, start, lambda d: d, steps=1)
    count = compilations()
    tuned = tuning.tune(bowl, start, lambda d: d, steps=200, out=tmp_path)
    again = compilations() - count
    assert again <= count  # 200 steps compile no more than one
    assert float(tuned.design["a"]) == pytest.approx(2.0, abs=1e-3)
    assert tuned.stopped == "steps" and bare.history["loss"].shape == (1,)
    saved = tuning.load_history(tmp_path)
    assert set(saved) == {"loss", "gradient_norm", "term:a", "design:a"}
    for name, column in saved.items():
        np.testing.assert_array_equal(column, tuned.history[name])
    assert tuned.loss == tuned.history["loss"].min()
    exact = tuning.tune(
        bowl, {"a": jnp.asarray(1.9)}, lambda d: d, optax.sgd(0.1), steps=200, tolerance=1e-6
    )
    assert exact.stopped == "tolerance" and len(exact.history["loss"]) < 200


class Killed:
    """A meter at whose seventh step the run is interrupted."""

    def init(self):
        return 0

    def step(self, state, progress):
        if state == 6:
            raise KeyboardInterrupt
        return state + 1

    def close(self, state):
        self.closed = True


def test_a_killed_run_leaves_its_history(tmp_path):
    meter = Killed()
    with pytest.raises(KeyboardInterrupt):
        tuning.tune(bowl, {"a": 1.0}, lambda d: d, out=tmp_path, progress=meter)
    assert meter.closed
    assert tuning.load_history(tmp_path)["loss"].shape == (7,)
    assert [f.name for f in tmp_path.iterdir()] == ["history.npz"]
    with pytest.raises(ValueError, match="history.npz is not there"):
        tuning.load_history(tmp_path / "elsewhere")


def test_what_is_not_finite_stops():
    root = lambda built, keys: jnp.sqrt(1.0 - built["a"])
    with pytest.warns(RuntimeWarning, match=r"step \d+: the objective is nan at a = "):
        tuned = tuning.tune(root, {"a": 0.5}, lambda d: d, optax.sgd(0.3), steps=50)
    assert tuned.stopped == "not finite" and np.isfinite(tuned.loss)
    with pytest.raises(ValueError, match="objective is nan at a = 2.0.*Bounded"):
        tuning.tune(root, {"a": 2.0}, lambda d: d)
    norm = lambda built, keys: jnp.sqrt(built["a"] ** 2) + built["b"]
    with pytest.raises(ValueError, match="derivative by a = 0.0 is not.*double `where`"):
        tuning.tune(norm, {"a": 0.0, "b": 1.0}, lambda d: d)


@pytest.mark.parametrize(
    ("design", "options", "words"),
    [
        ({"a": 1.0, "n": 3}, {}, "leaf 'n' is 3 of type int64.*relax it"),
        ({"a": jnp.nan}, {}, "leaf 'a' is nan; start from finite"),
        ({}, {}, "the design has no leaves"),
        ({"a": 1.0, "b": {"c": 1.0}}, {}, "does not depend on 'b.c'"),
        ({"a": 1.0}, {"cases": 0}, "cases is 0; give an integer of at least 1"),
        ({"a": 1.0}, {"steps": 0}, "steps is 0"),
        ({"a": 1.0}, {"tolerance": -1.0}, "tolerance is -1.0"),
        ({"a": 1.0}, {"optimizer": "adam"}, "optimizer is 'adam'; give an Optax"),
        ({"a": jnp.ones(2)}, {}, r"returned shape \(2,\); give a scalar"),
    ],
)
def test_refuses(design, options, words):
    of = lambda built, keys: (built["a"] - 2) ** 2
    with pytest.raises(ValueError, match=words):
        tuning.tune(of, design, lambda d: d, **options)


def test_refuses_what_has_no_gradient():
    of = lambda built, keys: jnp.round(built["a"]) * 1.0
    with pytest.raises(ValueError, match="gradient is zero at the start"):
        tuning.tune(of, {"a": 1.2}, lambda d: d)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: tuning.Bounded(3.0, 0.0, 3.0), "value 3.0 is not between"),
        (lambda: tuning.Ascending([0.0, 0.5, 0.4, 1.0]), "ascending order"),
        (lambda: tuning.Ascending([0.0, 1.0]), "at least three"),
        (lambda: tuning.cooling(0.1, 1.0, 10), "need start >= end > 0"),
        (lambda: tuning.counted(lambda n: n, 9.0, 0.0, 1, 4), "rounds to 9, outside 1 ... 4"),
        (lambda: tuning.exhaustive(lambda n: np.nan, [1, 2]), "finite objective"),
        (lambda: tuning.Flown(START, save="all"), "save is 'all'"),
        (lambda: tuning.Flown(START, chunk=0), "chunk is 0"),
        (lambda: problems.design("earth-mers"), "did you mean 'earth-mars'"),
        (lambda: problems.design("moon-lander", segments=1), "segments is 1"),
    ],
)
def test_refuses_parts(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_maps():
    for lo, hi in ((0.0, 3.0), (0.0, np.inf), (-np.inf, 3.0), (-np.inf, np.inf)):
        node = tuning.Bounded(jnp.array([0.5, 2.5]), lo, hi)
        np.testing.assert_allclose(node.value, [0.5, 2.5], rtol=1e-14)
        far = eqx.tree_at(lambda n: n.raw, node, jnp.array([-30.0, 30.0])).value
        assert np.all((far >= lo) & (far <= hi))
    places = tuning.Ascending([0.0, 0.1, 0.7, 2.0])
    np.testing.assert_allclose(places.value, [0.0, 0.1, 0.7, 2.0], atol=1e-15)
    heat = tuning.cooling(1.0, 0.1, 100, hold=0.2)
    assert heat(0) == 1.0 and heat(80) == heat(99) == pytest.approx(0.1)
