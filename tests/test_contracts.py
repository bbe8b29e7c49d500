"""Every implementation of a contract that users extend keeps that contract.

To add a contract: one entry in CONTRACTS, a function of the state that uses an instance, and one in
EXAMPLES for each class that fulfils it. A class without an example fails by name.
"""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import dataclasses
import importlib
import inspect
import pkgutil
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator, FreeTime, once, slow

import jaxguide as jg
from jaxguide.flight.actuators import LimitedCommand, PlainActuator
from jaxguide.flight.disturbances import PlainDisturbance
from jaxguide.flight.estimators import PlainEstimator
from jaxguide.flight.sample import EitherCommand
from jaxguide.flight.sensors import PlainSensor
from jaxguide.laws.gain_interpolation import Interpolation
from jaxguide.laws.holds import HeldControl, HeldDeviation, PlainHold
from jaxguide.laws.lanes import SampleGrid
from jaxguide.laws.law import NominalCommand
from jaxguide.laws.neighboring import NeighboringCommand, PreparedCommand, PreparedNeighboring
from jaxguide.laws.suboptimal import SuboptimalCommand
from jaxguide.tuning.thinned import ThinnedGains

T, NEXT = 0.25, 0.5  # the sample at which everything is used, and the next one
X = (0.2, 0.5)


@pytest.fixture(scope="module")
def world(double_integrator):
    """Solved problems and laws about them."""
    free = jg.solve(FreeTime(), jg.PiecewiseLinear(3, 4, starts=1))
    law = jg.NeighboringOptimal(jg.gain_schedule(double_integrator, np.arange(10) / 10), cap=9.0)
    grid = SampleGrid(jnp.array([T]), jnp.array([[T, (T + NEXT) / 2, NEXT]]))
    prepared = jax.tree_util.tree_map(lambda a: a[0], law.prepared(grid, True))
    schedule = jg.suboptimal_gains(free, stations=(0.0, 0.4, 0.8))
    return SimpleNamespace(
        nominal=double_integrator,
        law=law,
        prepared=prepared,
        schedule=schedule,
        suboptimal=jg.NeighboringSuboptimal(schedule),
        to_go=jg.TimeToGo(schedule),
    )


def commanded(law, x):
    return law(T, x, law.start(x))[0]


def either(w, x):
    first, second = constant(x), constant(2 * x)
    return EitherCommand(first, second, x[0] > 0, first.result, first.saturated)


def limited(w, x):
    command = constant(x)
    limits = (jnp.array([-2.0]), jnp.array([2.0]))
    return LimitedCommand(command, limits, command.result, command.saturated)


def constant(x):
    """A command that costs nothing to compile."""
    success = jg.RESULTS.where(jnp.array(True), jg.RESULTS.successful, jg.RESULTS.diverged)
    return HeldControl(x[:1], -2 * x[1:], success, jnp.array(False))


def noisy(key, t, x):
    return x + jax.random.normal(key, x.shape, x.dtype)


# An instance of each class: of the world and, where it depends on one, of a state.
EXAMPLES = {
    jg.OpenLoop: lambda w, x: jg.OpenLoop(w.nominal),
    jg.NeighboringOptimal: lambda w, x: w.law,
    PreparedNeighboring: lambda w, x: w.prepared,
    jg.NeighboringSuboptimal: lambda w, x: w.suboptimal,
    jg.TimeToGo: lambda w, x: w.to_go,
    NominalCommand: lambda w, x: commanded(jg.OpenLoop(w.nominal), x),
    NeighboringCommand: lambda w, x: commanded(w.law, x),
    PreparedCommand: lambda w, x: commanded(w.prepared, x),
    SuboptimalCommand: lambda w, x: commanded(w.suboptimal, x),
    HeldDeviation: lambda w, x: jg.HoldDeviation()(constant(x), T, None)[0],
    HeldControl: lambda w, x: jg.HoldControl()(constant(x), T, None)[0],
    EitherCommand: either,
    LimitedCommand: limited,
    jg.History: lambda w, x: jg.History(),
    jg.HoldDeviation: lambda w, x: jg.HoldDeviation(),
    jg.HoldControl: lambda w, x: jg.HoldControl(),
    PlainHold: lambda w, x: PlainHold(lambda command, t_k: command),
    PlainSensor: lambda w, x: PlainSensor(noisy),
    PlainEstimator: lambda w, x: PlainEstimator(lambda t, y: y / 2),
    PlainDisturbance: lambda w, x: PlainDisturbance(lambda t, x: t * x),
    jg.ControlLimits: lambda w, x: jg.ControlLimits(),
    PlainActuator: lambda w, x: PlainActuator(lambda command, t_k: command),
    jg.RungeKutta4: lambda w, x: jg.RungeKutta4(2),
    jg.Adaptive: lambda w, x: jg.Adaptive(1e-6),
    jg.LinearGains: lambda w, x: jg.LinearGains(),
    jg.TimeToGoGains: lambda w, x: jg.TimeToGoGains((2, 1)),
    jg.Shooting: lambda w, x: jg.Shooting(arcs=2, segments=4, degree=6, starts=2, coarse_steps=16),
    jg.Pseudospectral: lambda w, x: jg.Pseudospectral(nodes=4, segments=1, refinements=0),
    jg.PiecewiseLinear: lambda w, x: jg.PiecewiseLinear(3, 4, starts=2),
    ThinnedGains: lambda w, x: ThinnedGains((2, 1), jnp.array([1.0, 0.5, 1.0])),
}


# How an instance is used with a state: its results, the memory before and the memory after. -------


def use_command(command, w, x):
    nominal, deviation, whole = command.nominal(T), command.deviation(T), command(T)
    assert nominal.shape == deviation.shape == whole.shape == (1,)
    assert command.saturated.shape == () and command.saturated.dtype == bool
    assert isinstance(command.result, jg.RESULTS)
    return (nominal, deviation, whole), None, None


def use_law(law, w, x):
    before = law.start(x)
    command, after = law(T, x, before)
    assert isinstance(command, jg.Command)
    assert not law.decides_end or command.time_to_go.shape == ()
    if law.decides_end:
        assert jnp.shape(law.latest_end(0.0)) == ()
    return use_command(command, w, x)[0], before, after


def use_hold(hold, w, x):
    before = hold.start()
    command, after = hold(constant(x), T, before)
    assert isinstance(command, jg.Command)
    return (*use_command(command, w, x)[0], command(NEXT)), before, after


def use_sensor(sensor, w, x):
    key = jax.random.key(0) if sensor.random else None
    before = sensor.start(key, x)
    y, after = sensor(key, T, x, before)
    assert y.ndim == 1 and y.dtype == x.dtype
    return y, before, after


def use_estimator(estimator, w, x):
    before = estimator.start(x)
    estimate, after = estimator.update(before, T, x)
    assert isinstance(estimate, jg.Estimate) and estimate.state.shape == x.shape
    assert estimate.covariance is None or estimate.covariance.shape == (x.size, x.size)
    return estimate, before, estimator.predict(after, constant(x), T, NEXT)


def use_disturbance(disturbance, w, x):
    key = jax.random.key(0) if disturbance.random else None
    before = disturbance.start(key, x)
    rate, after = disturbance(key, T, x, before)
    assert rate.shape == x.shape and rate.dtype == x.dtype
    return rate, before, after


def use_actuator(actuator, w, x):
    before = actuator.start(DoubleIntegrator(control_bounds=(-2.0, 2.0)))
    command, after = actuator(constant(x), T, before)
    assert isinstance(command, jg.Command)
    return (*use_command(command, w, x)[0], command(NEXT)), before, after


def use_integrator(integrator, w, x):
    rate, flown = DoubleIntegrator().dynamics, constant(x)
    new, result = integrator.across(rate, flown, T, NEXT, x)
    still, _ = integrator.across(rate, flown, T, T, x)
    assert new.shape == still.shape == x.shape and new.dtype == x.dtype
    assert isinstance(result, jg.RESULTS)
    # Where it moved in no time, a number that the checks refuse.
    moved = jnp.any(still != x) & jnp.all(jnp.isfinite(x))
    return jnp.where(moved, jnp.inf, new), None, None


def use_interpolation(interpolation, w, x):
    gains = interpolation(w.schedule, x[0])
    assert gains.here.shape == gains.ahead.shape == (1, 2) and gains.time.shape == (2,)
    return gains, None, None


def use_method(method, w, x):
    """One solve from a state; NaN among its numbers is never a success."""
    stated = dataclasses.replace(DoubleIntegrator(), initial_state=x)
    problem = jax.tree_util.tree_map(jnp.asarray, stated)
    method.check(problem)
    extremal = method(problem, None)
    n = extremal.t.shape[0]
    assert isinstance(extremal, jg.Extremal) and not isinstance(extremal, jg.Certified)
    assert extremal.x.shape == extremal.costate.shape == (n, 2) and extremal.u.shape == (n, 1)
    assert isinstance(method.accuracy, float) and isinstance(method.capabilities, jg.Capabilities)
    good = extremal.result == jg.RESULTS.successful
    kept = good == jnp.all(jnp.isfinite(x))
    return jnp.where(kept, extremal.objective, jnp.inf), None, None


CONTRACTS = {
    jg.Method: use_method,
    jg.Law: use_law,
    jg.Command: use_command,
    jg.Hold: use_hold,
    jg.Sensor: use_sensor,
    jg.Estimator: use_estimator,
    jg.Disturbance: use_disturbance,
    jg.Actuator: use_actuator,
    jg.Integrator: use_integrator,
    Interpolation: use_interpolation,
}


# The checks -----------------------------------------------------------------------------------

for module in pkgutil.walk_packages(jg.__path__, "jaxguide."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)


def below(contract):
    """Every class of the package that derives from `contract`."""
    found = {c for child in contract.__subclasses__() for c in (child, *below(child))}
    return {c for c in found if c.__module__.startswith("jaxguide.")}


def concrete(contract):
    classes = [c for c in below(contract) if not inspect.isabstract(c)]
    return sorted(classes, key=lambda c: c.__qualname__)


CASES = [(contract, c) for contract in CONTRACTS for c in concrete(contract)]
# A solve with its batch and gradient compiles for half a minute, Diffrax's flights for a quarter.
LONG = (jg.Method, jg.Adaptive)
MARKED = [slow(*c) if c[0] in LONG or c[1] in LONG else c for c in CASES]
NAMES = [f"{a.__name__}-{b.__name__}" for a, b in CASES]
each = pytest.mark.parametrize(("contract", "implementation"), CASES, ids=NAMES)
each_marked = pytest.mark.parametrize(("contract", "implementation"), MARKED, ids=NAMES)


def documented(cls):
    """Whether it says in words of its own what it is: dataclasses write a signature where not."""
    return bool(cls.__doc__) and not cls.__doc__.startswith(f"{cls.__name__}(")


@pytest.mark.parametrize("contract", CONTRACTS, ids=lambda c: c.__name__)
def test_contracts_are_documented(contract):
    assert documented(contract)
    for cls in (contract, *below(contract)):
        for name in cls.__abstractmethods__:
            assert inspect.getdoc(getattr(cls, name)), f"{cls.__name__}.{name}"


@each
def test_signatures_and_docstrings(contract, implementation):
    assert documented(implementation)
    each_of = lambda f: inspect.signature(f).parameters.values()
    parameters = lambda f: [(p.name, p.kind, p.default) for p in each_of(f)]
    for name, method in vars(contract).items():
        if inspect.isfunction(inspect.unwrap(method)) and (name == "__call__" or name[0] != "_"):
            own = getattr(implementation, name)
            assert parameters(own) == parameters(getattr(contract, name)), name


@each_marked
def test_behaviour(contract, implementation, request):
    # The slow run makes no world: its examples are of none.
    world = None if contract in LONG or implementation in LONG else request.getfixturevalue("world")
    assert implementation in EXAMPLES, f"no example of {implementation.__name__}: add one"
    make = EXAMPLES[implementation]

    def use(x):
        part = make(world, x)
        assert type(part) is implementation
        results, before, after = CONTRACTS[contract](part, world, x)
        kind = lambda a: (jnp.shape(a), jnp.result_type(a))
        same = lambda a, b: kind(a) == kind(b)
        kept = jax.tree_util.tree_map(same, before, after)  # raises where structures differ
        assert all(jax.tree_util.tree_leaves(kept))
        return results, after

    numbers = lambda tree: jax.tree_util.tree_leaves(eqx.filter(tree, eqx.is_inexact_array))

    def total(x):
        used = use(x)
        return sum(jnp.sum(a) for a in numbers(used)), used

    @once
    def everything(x):
        batch = jax.vmap(use)(jnp.stack([x, x + 0.01]))
        (_, alone), slope = jax.value_and_grad(total, has_aux=True)(x)
        return alone, batch, slope

    alone, batch, slope = everything(jnp.array(X))
    for a, b in zip(numbers(alone), numbers(batch), strict=True):
        # The same operations, perhaps fused otherwise: rounding only.
        np.testing.assert_allclose(b[0], a, rtol=1e-12, atol=1e-12)
        assert np.all(np.isfinite(b))
    assert slope.shape == (2,) and np.all(np.isfinite(slope))
    undefined, _, slope = everything(jnp.full(2, jnp.nan))  # a value, whatever it is
    assert [a.shape for a in numbers(undefined)] == [a.shape for a in numbers(alone)]
    if contract is jg.Method:  # a finite derivative would be that of no solution
        assert slope.shape == (2,) and np.all(np.isnan(slope))


def test_no_example_is_of_nothing():
    assert set(EXAMPLES) == {implementation for _, implementation in CASES}
