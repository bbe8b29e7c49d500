"""Laws, holds and flights: against hand-written loops, the paper's cases and finite differences."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportAssignmentType=false

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator, FreeTime, at

import jaxguide as jg
from jaxguide.flight.simulate import prepare
from jaxguide.sweeping.sweep import cast

START = (0.1, -0.1)
simulate = eqx.filter_jit(jg.simulate)


class Drag(DoubleIntegrator):
    """The double integrator with a nonlinear drag its law knows nothing of."""

    drag: float = 0.3

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], self.k * u[0] - self.drag * x[1] ** 3])


@pytest.fixture(scope="module")
def law(double_integrator):
    return jg.NeighboringOptimal(jg.gain_schedule(double_integrator, np.arange(10) / 10))


@pytest.fixture(scope="module")
def mission(law):
    return jg.Mission(DoubleIntegrator(), law, START, 0.1)


def by_hand(start, samples, hold, cap=math.inf, push=0.0, last_history=False):
    """The loop about u* = 6 - 12 t on x'' = u + push in plain Python, each sample exact."""
    dx = np.array(start, float)  # deviation from the nominal
    saturated, commands = 0, []
    for t, t_next in zip(samples[:-1], samples[1:], strict=True):
        T, h = 1 - t, t_next - t
        du = -6 / T**2 * dx[0] - 4 / T * dx[1]
        saturated += abs(du) > cap
        du = float(np.clip(du, -cap, cap))
        commands.append(du)
        slope = 0.0
        if hold == "history" or (last_history and t_next == samples[-1]):
            slope = 12 / T**3 * dx[0] + 6 / T**2 * dx[1]
        if hold == "control":  # u*(t) is not followed: it falls by 12 a unit of time
            slope = 12.0
        a = du + push
        dx = np.array(
            [dx[0] + h * dx[1] + a * h**2 / 2 + slope * h**3 / 6, dx[1] + a * h + slope * h**2 / 2]
        )
    return np.array([1.0, 0.0]) + dx, commands, saturated


SAMPLES = np.append(np.arange(10) / 10, 1.0)


# Commands and holds ---------------------------------------------------------------------------


def test_a_command_keeps_the_deviation_apart(law):
    @eqx.filter_jit
    def ask(law, t):
        command, memory = law(0.2, jnp.array([0.2, 0.5]), law.start(jnp.zeros(2)))
        assert memory is None
        return (
            command.nominal(t),
            command.deviation(t),
            command(t),
            command.result,
            command.saturated,
        )

    x = at(law.schedule.extremal, jnp.asarray(0.2)).x
    dx = np.array([0.2, 0.5]) - np.asarray(x)
    for t in (0.2, 0.25, 0.9, 1.0):
        T, s = 0.8, t - 0.2
        du = (-6 / T**2 + 12 * s / T**3) * dx[0] + (-4 / T + 6 * s / T**2) * dx[1]
        nominal, deviation, whole, result, saturated = ask(law, jnp.asarray(t))
        np.testing.assert_allclose(nominal, [6 - 12 * t], rtol=0, atol=1e-10)
        np.testing.assert_allclose(deviation, [du], rtol=1e-8)
        np.testing.assert_allclose(whole, nominal + deviation, rtol=1e-15)
        assert bool(result == jg.RESULTS.successful) and not bool(saturated)


def test_holds(law):
    command, _ = law(0.2, jnp.array([0.2, 0.5]), None)
    du, u = command.deviation(0.2), command.nominal(0.2)
    deviation, _ = jg.HoldDeviation()(command, 0.2, None)
    control, _ = jg.HoldControl()(command, 0.2, None)
    assert jg.History()(command, 0.2, None)[0] is command
    np.testing.assert_array_equal(deviation.deviation(0.27), du)
    np.testing.assert_array_equal(deviation.nominal(0.27), command.nominal(0.27))
    np.testing.assert_array_equal(control.deviation(0.27), du)
    np.testing.assert_array_equal(control.nominal(0.27), u)
    np.testing.assert_array_equal(control(0.27), u + du)


def test_outside_the_horizon_the_law_says_so(law):
    for t in (-0.1, 1.0, 1.5):
        command, _ = law(t, jnp.array([0.0, 0.0]), None)
        assert bool(command.result == jg.RESULTS.outside_horizon), t


def test_cap_and_scale(law):
    x = law.schedule.extremal(0.2).x + jnp.array([0.1, 0.0])
    full = law(0.2, x, None)[0].deviation(0.2)
    half = dataclasses.replace(law, scale=0.5)(0.2, x, None)[0].deviation(0.2)
    np.testing.assert_allclose(half, full / 2, rtol=1e-14)
    capped, _ = dataclasses.replace(law, cap=0.3)(0.2, x, None)
    np.testing.assert_array_equal(capped.deviation(0.2), [-0.3])
    assert bool(capped.saturated)
    # the cap limits the history as well, at every time of its own
    np.testing.assert_array_equal(capped.deviation(1.0), [0.3])
    for cap in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match=f"cap is {cap}; give a positive bound"):
            dataclasses.replace(law, cap=cap)


class Halved(jg.NeighboringOptimal):
    """Derived from a law that can be looked up, but commands otherwise."""

    def __call__(self, t_k, x, memory):
        return dataclasses.replace(self.law_within(), scale=0.5)(t_k, x, memory)

    def law_within(self):
        return jg.NeighboringOptimal(self.schedule, self.cap, self.scale)


def test_the_fast_path_is_not_inherited(mission, law):
    halved = Halved(law.schedule)
    assert prepare(mission).laws is not None
    assert prepare(dataclasses.replace(mission, law=halved)).laws is None
    flown, known = (
        simulate(dataclasses.replace(mission, law=one))
        for one in (halved, dataclasses.replace(law, scale=0.5))
    )
    # One by the plain contracts, the other by gains looked up: rounding times gains of 600.
    np.testing.assert_allclose(flown.x, known.x, rtol=0, atol=1e-12)


def test_a_prepared_command_does_not_answer_at_other_times(mission):
    first = jax.tree_util.tree_map(lambda a: a[0], prepare(mission).laws)
    command, _ = first(0.0, jnp.asarray(START), None)
    np.testing.assert_allclose(command(0.0), [6 - 0.2], rtol=0, atol=1e-8)
    for ask in (command.nominal, command.deviation, command):
        with pytest.raises(ValueError, match="asked for its control at another time"):
            ask(0.05)


# Flights against a loop by hand ---------------------------------------------------------------

VARIANTS = {  # hold, options of the mission, options of the loop by hand
    "deviation": (jg.HoldDeviation(), {}, {}),
    "control": (jg.HoldControl(), {}, {}),
    "history": (jg.History(), {}, {}),
    "deviation, last history": (jg.HoldDeviation(), {"last": jg.History()}, {"last_history": True}),
    "deviation, pushed": (
        jg.HoldDeviation(),
        {"disturbance": lambda t, x: jnp.array([0.0, 0.25])},
        {"push": 0.25},
    ),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_flights_against_a_loop_by_hand(mission, variant):
    hold, options, known = VARIANTS[variant]
    flown = dataclasses.replace(mission, hold=hold, **options)
    flight = simulate(flown)
    want, commands, _ = by_hand(START, SAMPLES, variant.split(",")[0], **known)
    # The path is a cubic in time within a sample, which RK4 flies exactly; gains are good to 1e-9.
    np.testing.assert_allclose(flight.final_state, want, rtol=0, atol=1e-8)
    np.testing.assert_allclose(flight.commands[:, 0], commands, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(flight.u[:, 0], 6 - 12 * SAMPLES[:-1] + commands, rtol=0, atol=1e-7)
    np.testing.assert_allclose(flight.t, SAMPLES, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(flight.x[0], START)
    np.testing.assert_array_equal(flight.x[-1], flight.final_state)
    assert bool(flight.result == jg.RESULTS.successful) and float(flight.final_time) == 1.0
    if "history" in variant:  # a linear plant is then brought to its target exactly
        np.testing.assert_allclose(flight.final_state, [1, 0], rtol=0, atol=1e-9)


def test_cap_in_flight(mission):
    start = (0.1, -0.1)  # asks for 0.2 at first, 0.33 at most
    flown = eqx.tree_at(lambda m: (m.law.cap, m.initial_state), mission, (0.25, jnp.array(start)))
    flight = simulate(flown)
    want, commands, saturated = by_hand(start, SAMPLES, "deviation", cap=0.25)
    np.testing.assert_allclose(flight.final_state, want, rtol=0, atol=1e-8)
    np.testing.assert_allclose(flight.commands[:, 0], commands, rtol=1e-7, atol=1e-8)
    assert 0 < saturated < 10 and float(flight.saturated) == saturated
    assert float(jnp.abs(flight.commands).max()) == 0.25


def test_an_interval_that_does_not_divide_the_horizon(law):
    flight = simulate(jg.Mission(DoubleIntegrator(), law, START, 0.3))
    samples = np.array([0.0, 0.3, 0.6, 0.9, 1.0])
    np.testing.assert_allclose(flight.t, samples, rtol=0, atol=1e-15)
    want, _, _ = by_hand(START, samples, "deviation")
    np.testing.assert_allclose(flight.final_state, want, rtol=0, atol=1e-8)


def test_spare_samples_change_nothing(mission, law):
    flight = simulate(jg.Mission(DoubleIntegrator(), law, START, 0.1, max_samples=13))
    np.testing.assert_allclose(
        flight.final_state, simulate(mission).final_state, rtol=0, atol=1e-12
    )
    assert bool(flight.result == jg.RESULTS.successful)


def test_saving_only_the_ends(mission):
    flight, whole = simulate(mission, save="ends"), simulate(mission)
    assert flight.t.shape == (2,) and flight.x.shape == (2, 2)
    np.testing.assert_array_equal(flight.final_state, whole.final_state)
    with pytest.raises(ValueError, match="save is 'all'"):
        jg.simulate(mission, save="all")


def test_open_loop(double_integrator):
    flown = jg.Mission(DoubleIntegrator(), jg.OpenLoop(double_integrator), START, 0.1)
    flight = simulate(flown)
    # Deviation drifts: dx(1) = dx + dv, dv(1) = dv
    np.testing.assert_allclose(flight.final_state, [1 + 0.1 - 0.1, -0.1], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(flight.commands, np.zeros((10, 1)))


def test_a_plant_unlike_the_law_s_own(mission):
    flown = eqx.tree_at(lambda m: m.plant.k, mission, jnp.asarray(1.05))
    miss = lambda flight: np.abs(np.asarray(flight.final_state) - [1, 0])
    closed = miss(simulate(flown))
    opened = miss(
        simulate(dataclasses.replace(flown, law=jg.OpenLoop(mission.law.schedule.extremal)))
    )
    # Feedback at ten samples takes out most of a 5 per cent error of the plant.
    assert np.all(closed[0] < 0.2 * opened[0])


class Noise(eqx.Module):
    noise: jax.Array

    def __call__(self, key, t, x):
        return x + self.noise * jax.random.normal(key, x.shape, x.dtype)


class Blend(jg.Estimator):
    """Half the measurement, half the last estimate."""

    def start(self, x0):
        return x0

    def predict(self, memory, flown, t, t_next):
        return memory

    def update(self, memory, t, y):
        x = (y + memory) / 2
        return jg.Estimate(x), x


def test_sensor_and_estimator(mission):
    key = jax.random.key(5)
    sensed = dataclasses.replace(mission, sensor=Noise(jnp.asarray(0.01)))
    with pytest.raises(ValueError, match="needs a PRNG key; pass key="):
        jg.simulate(sensed)
    noisy, again, other = (
        simulate(sensed, key),
        simulate(sensed, key),
        simulate(sensed, jax.random.key(6)),
    )
    np.testing.assert_array_equal(noisy.commands, again.commands)
    assert not np.allclose(noisy.commands, other.commands)
    # The first command by hand: K(0) of what the sensor shows, not of the state.
    shown = np.array(START) + 0.01 * np.asarray(jax.random.normal(jax.random.fold_in(key, 0), (2,)))
    np.testing.assert_allclose(noisy.commands[0, 0], -6 * shown[0] - 4 * shown[1], rtol=1e-8)
    silent = dataclasses.replace(mission, sensor=Noise(jnp.asarray(0.0)))
    np.testing.assert_array_equal(simulate(silent, key).commands, simulate(mission).commands)
    both = simulate(dataclasses.replace(sensed, estimator=Blend()), key)
    blended = (shown + np.array(START)) / 2
    np.testing.assert_allclose(both.commands[0, 0], -6 * blended[0] - 4 * blended[1], rtol=1e-8)
    np.testing.assert_array_equal(both.x[0], START)  # the state itself is not noisy


# Integrators ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "hold",
    [jg.HoldDeviation(), jg.History()],
    ids=["held", "history"],
)
@pytest.mark.slow
def test_fixed_steps_converge_at_fourth_order_to_adaptive(law, hold):
    fly = lambda integrator: np.asarray(
        simulate(
            jg.Mission(Drag(drag=0.5), law, START, 0.25, hold=hold, integrator=integrator)
        ).final_state
    )
    exact = fly(jg.Adaptive(1e-13))
    errors = [np.abs(fly(jg.RungeKutta4(steps)) - exact).max() for steps in (2, 4, 8)]
    # Halving the step divides the error by 2^4, up to the next order: 12 to 24 here.
    for coarse, fine in zip(errors[:-1], errors[1:], strict=True):
        assert 12 < coarse / fine < 24, errors
    assert errors[-1] > 1e-10  # far above rounding and gain errors: the ratios mean something


def test_samples_outside_the_schedule_fly_alike(double_integrator):
    """Gains known at few times: both integrators must take the same gain at every sample."""
    sparse = jg.NeighboringOptimal(jg.gain_schedule(double_integrator, np.linspace(0.2, 0.6, 10)))
    fly = lambda integrator: (
        simulate(jg.Mission(DoubleIntegrator(), sparse, START, 0.1, integrator=integrator)).commands
    )
    np.testing.assert_allclose(fly(jg.RungeKutta4()), fly(jg.Adaptive()), rtol=1e-7, atol=1e-9)


def test_refuses_integrators():
    with pytest.raises(ValueError, match="steps is 0"):
        jg.RungeKutta4(0)
    with pytest.raises(ValueError, match="tolerance is 0"):
        jg.Adaptive(0.0)


# Failures -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"initial_state": (math.nan, 0.0)}, "initial_state has x = nan; give finite"),
        ({"initial_state": (0.0, math.inf)}, "initial_state has v = inf"),
        ({"initial_state": (0.0, 0.0, 0.0)}, r"shape \(3,\); give 2 numbers.*'x', 'v'"),
        ({"initial_state": 0.0}, r"shape \(\); give 2 numbers"),
        ({"sample_interval": 0.0}, "sample_interval is 0.0; give a positive"),
        ({"sample_interval": -0.1}, "sample_interval is -0.1; give a positive"),
        ({"sample_interval": math.nan}, "sample_interval is nan"),
        ({"sample_interval": 1.5}, "1.5 is longer than the horizon 1.0"),
        ({"final_time": 0.0}, r"horizon \[0.0, 0.0\] must be"),
        ({"final_time": -1.0}, "positive length"),
        ({"final_time": math.inf}, "must be finite"),
        ({"initial_time": 2.0}, r"horizon \[2.0, 1.0\]"),
        ({"max_samples": 0}, "max_samples is 0"),
        ({"delay": 0.1}, "delay is 0.1"),
    ],
)
def test_mission_refuses(law, options, words):
    given = {"initial_state": START, "sample_interval": 0.1, **options}
    with pytest.raises(ValueError, match=words):
        jg.Mission(DoubleIntegrator(), law, **given)


def test_mission_refuses_a_free_final_time(law):
    with pytest.raises(ValueError, match="final_time is free; pass final_time=extremal.final_time"):
        jg.Mission(FreeTime(), law, START, 0.1)
    assert jg.Mission(FreeTime(), law, START, 0.1, final_time=2.0).max_samples == 20


def test_a_traced_interval_needs_its_number_of_samples(law):
    with pytest.raises(ValueError, match="max_samples must be given"):
        jax.jit(lambda h: jg.Mission(DoubleIntegrator(), law, START, h).initial_state)(0.1)


def test_too_few_samples_are_refused(law):
    """Else the last sample would silently be longer than the interval."""
    with pytest.raises(ValueError, match="max_samples"):
        jg.Mission(DoubleIntegrator(), law, START, 0.1, max_samples=5)


class Wall(DoubleIntegrator):
    """Infinite acceleration while 0.4 < t < 0.6, if `height` is above 0."""

    height: float = 0.0

    def dynamics(self, t, x, u):
        inside = (t > 0.4) & (t < 0.6) & (self.height > 0)
        return jnp.stack([x[1], u[0] + jnp.where(inside, jnp.inf, 0.0)])


@pytest.mark.parametrize(
    "integrator", [jg.RungeKutta4(), jg.Adaptive(1e-9)], ids=["fixed", "adaptive"]
)
def test_a_diverging_plant_is_flagged_and_held(law, integrator):
    flight = simulate(jg.Mission(Wall(height=1.0), law, START, 0.1, integrator=integrator))
    assert bool(flight.result == jg.RESULTS.diverged)
    assert np.all(np.isfinite(flight.x))
    # Held at its last finite value to the end.
    np.testing.assert_array_equal(flight.x[5:], np.broadcast_to(flight.x[5], (6, 2)))


def test_one_diverging_lane_leaves_the_others(law):
    base = jg.Mission(Wall(), law, START, 0.1)

    @eqx.filter_jit
    def fly(heights):
        at = lambda h: eqx.tree_at(lambda m: m.plant.height, base, h)
        return jax.vmap(lambda h: jg.simulate(at(h)))(heights)

    good, bad = fly(jnp.zeros(6)), fly(jnp.zeros(6).at[2].set(1.0))
    others = np.array([0, 1, 3, 4, 5])
    np.testing.assert_array_equal(bad.x[others], good.x[others])
    diverged = int(jg.RESULTS.diverged._value)
    assert [int(c) == diverged for c in bad.result._value] == [
        False,
        False,
        True,
        False,
        False,
        False,
    ]


def test_float32_flights_stay_float32(mission):
    flight = simulate(cast(mission, "float32"))
    for leaf in (
        flight.t,
        flight.x,
        flight.u,
        flight.commands,
        flight.final_state,
        flight.saturated,
    ):
        assert leaf.dtype == jnp.float32
    want, _, _ = by_hand(START, SAMPLES, "deviation")
    # Gains of 600 times rounding of 1e-7 in the last sample, times its length.
    np.testing.assert_allclose(flight.final_state, want, rtol=0, atol=2e-5)
    with pytest.raises(ValueError, match="dtype is 'float16'"):
        cast(mission, "float16")


@pytest.mark.parametrize("hold", [jg.HoldDeviation(), jg.HoldControl(), jg.History()])
def test_a_float32_start_flies_with_float64_gains(law, hold):
    flown = jg.Mission(DoubleIntegrator(), law, jnp.asarray(START, jnp.float32), 0.1, hold=hold)
    assert simulate(flown).final_state.dtype == jnp.float32


def test_a_mission_is_arrays_only_and_passes_through_jit(mission):
    assert all(eqx.is_array(leaf) for leaf in jax.tree_util.tree_leaves(mission))
    flight = jax.jit(lambda m: jg.simulate(m))(mission)
    # inlined or not, the same operations: rounding only
    np.testing.assert_allclose(
        flight.final_state, simulate(mission).final_state, rtol=0, atol=1e-13
    )
