"""How users state a problem, and what they are told when it is stated badly."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportAssignmentType=false

import dataclasses
import math
import runpy

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SMALL, DoubleIntegrator, once

import jaxguide as jg
from jaxguide.bounds import bounds_of
from jaxguide.problem import (
    initial_values,
    initially_free,
    start_value,
    validate,
    with_array_leaves,
)


class Base(jg.Problem):
    """Everything the base class requires and no more."""

    state_names = ("x", "v")
    control_names = ("u",)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0]])


# What users write as plain class attributes ---------------------------------------------------


def test_unannotated_overrides_are_instance_leaves():
    class Stated(Base):
        initial_time = 0.25
        final_time = 2.5
        initial_state = (3.0, 4.0)

    leaves = jax.tree_util.tree_leaves(Stated())
    for value in (0.25, 2.5, 3.0, 4.0):
        assert value in leaves
    assert Stated().final_time == 2.5 and Stated.__dataclass_fields__["final_time"].default == 2.5


def test_replace_reaches_them_and_leaves_the_original():
    p = DoubleIntegrator()
    q = dataclasses.replace(p, initial_state=(0.5, 0.0), final_time=3.0, k=2.0)
    assert (q.initial_state, q.final_time, q.k) == ((0.5, 0.0), 3.0, 2.0)
    assert (p.initial_state, p.final_time, p.k) == ((0.0, 0.0), 1.0, 1.0)
    assert DoubleIntegrator(final_time=4.0).final_time == 4.0


def test_tree_at_reaches_them():
    moved = eqx.tree_at(
        lambda p: (p.initial_state[0], p.final_time), DoubleIntegrator(), (7.0, 8.0)
    )
    assert moved.initial_state == (7.0, 0.0) and moved.final_time == 8.0


def test_vmap_reaches_them():
    ensemble = jax.vmap(lambda tf: dataclasses.replace(DoubleIntegrator(), final_time=tf))(
        jnp.array([1.0, 2.0, 3.0])
    )
    twice = jax.vmap(lambda p: 2 * p.final_time + p.initial_state[0])
    batched = jax.tree_util.tree_map(lambda a: jnp.broadcast_to(a, (3,)), ensemble)
    np.testing.assert_array_equal(twice(batched), [2.0, 4.0, 6.0])


def test_grad_reaches_them():
    def value(p):
        x0 = initial_values(p, jnp.result_type(float))
        return p.final_time**2 + 5 * x0[1] + p.k**3

    p = with_array_leaves(dataclasses.replace(DoubleIntegrator(), final_time=3.0, k=2.0))
    g = jax.grad(value)(p)
    assert (float(g.final_time), float(g.initial_state[1]), float(g.k)) == (6.0, 5.0, 12.0)


def test_overriding_a_users_own_field():
    class Fast(DoubleIntegrator):
        k = 9.0

    assert Fast().k == 9.0 and 9.0 in jax.tree_util.tree_leaves(Fast())
    assert dataclasses.replace(Fast(), k=2.0).k == 2.0
    assert Fast(5.0).k == 5.0  # still the first positional field
    assert DoubleIntegrator().k == 1.0


@pytest.mark.parametrize(
    "value", [np.array([3.0, 4.0]), [3.0, 4.0], "jax"], ids=["numpy", "list", "jax"]
)
def test_arrays_and_lists_as_defaults(value):
    value = jnp.array([3.0, 4.0]) if isinstance(value, str) else value

    class Stated(Base):
        initial_state = value

    got, free = initial_values(Stated(), jnp.result_type(float)), initially_free(Stated())
    np.testing.assert_array_equal(got, [3.0, 4.0])
    assert free == (False, False)
    validate(Stated())
    assert dataclasses.replace(Stated(), initial_state=(0.0, 0.0)).initial_state == (0.0, 0.0)


def test_array_default_over_a_users_own_field():
    class Wider(DoubleIntegrator):
        target = np.array([2.0, 0.0])

    np.testing.assert_array_equal(Wider().target, [2.0, 0.0])
    assert DoubleIntegrator().target == (1.0, 0.0)


def test_free_as_a_class_attribute():
    class Stated(Base):
        final_time = jg.Free(0.5, 4.0, 1.5)
        initial_state = (1.0, jg.Free(guess=2.0))

    p = Stated()
    assert isinstance(p.final_time, jg.Free) and p.final_time.hi == 4.0
    x0, free = initial_values(p, jnp.result_type(float)), initially_free(p)
    np.testing.assert_array_equal(x0, [1.0, 2.0])
    assert free == (False, True)
    assert 4.0 in jax.tree_util.tree_leaves(p)
    validate(p)


def test_subclass_of_a_subclass():
    class Child(DoubleIntegrator):
        final_time = 2.0
        extra: float = 0.5

    class Grandchild(Child):
        extra = 0.75
        initial_state = (1.0, 1.0)

    p = Grandchild()
    assert (p.extra, p.final_time, p.initial_state, p.k) == (0.75, 2.0, (1.0, 1.0), 1.0)
    assert (Child().extra, Child().initial_state) == (0.5, (0.0, 0.0))
    moved = dataclasses.replace(p, extra=0.1, final_time=9.0)
    assert (moved.extra, moved.final_time) == (0.1, 9.0)


def test_fields_without_defaults_after_overrides():
    class Needs(Base):
        mass: float
        drag: float
        final_time = 2.0
        initial_state = (0.0, 1.0)

    p = Needs(1.5, drag=0.1)
    assert (p.mass, p.drag, p.final_time) == (1.5, 0.1, 2.0)
    with pytest.raises(TypeError, match="drag"):
        Needs(1.5)  # pyright: ignore[reportCallIssue]


def test_annotated_overrides_work_as_well():
    class Annotated(Base):
        final_time: float = 2.0

    assert Annotated().final_time == 2.0 and Annotated(final_time=3.0).final_time == 3.0


def test_names_are_static():
    p, q = Base(), Base(control_names=("w",))
    same = lambda a, b: jax.tree_util.tree_structure(a) == jax.tree_util.tree_structure(b)
    assert same(p, dataclasses.replace(p, final_time=2.0)) and not same(p, q)
    assert not any(isinstance(leaf, str) for leaf in jax.tree_util.tree_leaves(p))


def test_with_array_leaves_passes_through_jit():
    p = with_array_leaves(DoubleIntegrator())
    out = jax.jit(lambda p: dataclasses.replace(p, k=2 * p.k))(p)
    assert float(out.k) == 2.0 and out.state_names == ("x", "v")


def test_defaults_of_the_optional_methods():
    p, t = Base(), jnp.asarray(0.0)
    x, u = jnp.ones(2), jnp.ones(1)
    assert p.running_cost(t, x, u) == 0 and p.endpoint_cost(x, x, t, t) == 0
    assert p.endpoint_constraints(x, x, t, t).shape == (0,)
    assert p.path_constraints(t, x, u).shape == (0,) and p.integrands(t, x, u).shape == (0,)
    assert p.optimal_control(t, x, x) is None and not p.has_closed_form
    assert (p.n, p.m) == (2, 1)


def test_all_initial_states_are_free_when_absent():
    x0, free = initial_values(Base(), jnp.result_type(float)), initially_free(Base())
    np.testing.assert_array_equal(x0, [0.0, 0.0])
    assert free == (True, True)


@pytest.mark.parametrize(
    ("free", "start"),
    [
        (jg.Free(1.0, 3.0), 2.0),
        (jg.Free(1.0, 3.0, 1.5), 1.5),
        (jg.Free(), 0.0),
        (jg.Free(lo=2.0), 2.0),
        (jg.Free(hi=-2.0), -2.0),
    ],
)
def test_where_a_free_number_is_sought(free, start):
    assert float(start_value(free)) == start


def test_bounds_broadcast():
    lo, hi = bounds_of((-1.0, (2.0, 3.0)), 2, jnp.result_type(float))
    np.testing.assert_array_equal(lo, [-1.0, -1.0])
    np.testing.assert_array_equal(hi, [2.0, 3.0])


# Boundary data that follow from other fields: properties --------------------------------------

SCRIPT = """
from __future__ import annotations

import jax.numpy as jnp
import jaxguide as jg


class Hop(jg.Problem):
    half: float = 0.5
    lead: float = 0.0
    state_names = ("x", "v")
    control_names = ("u",)

    @property
    def final_time(self):
        return 2 * self.half

    @property
    def initial_state(self):
        return (self.lead, 0.0)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0]])

    def running_cost(self, t, x, u):
        return 0.5 * u[0] ** 2

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf - jnp.array([1.0, 0.0])
"""


@pytest.fixture(scope="module")
def hop(tmp_path_factory):
    """A user's script: `lead` ahead of the start, from rest to rest at 1 in twice `half`; the
    cost is 6 (1 - lead)^2 / (2 half)^3."""
    script = tmp_path_factory.mktemp("user") / "script.py"
    script.write_text(SCRIPT)
    return runpy.run_path(str(script), run_name="__main__")["Hop"]


def test_properties_are_no_fields(hop):
    names = [f.name for f in dataclasses.fields(hop)]
    assert "final_time" not in names and "initial_state" not in names and "half" in names
    p = dataclasses.replace(hop(), half=2.0)
    assert (p.final_time, p.initial_state, hop().final_time) == (4.0, (0.0, 0.0), 1.0)
    assert 1.0 not in jax.tree_util.tree_leaves(hop())  # the final time
    for change in (dict(final_time=2.0), dict(initial_state=(0.0, 0.0))):
        with pytest.raises(TypeError, match=next(iter(change))):
            dataclasses.replace(p, **change)
        with pytest.raises(TypeError, match=next(iter(change))):
            hop(**change)
    validate(p)
    assert "final_time -2.0 is not after" in refusal(hop(half=-1.0))


@pytest.mark.slow
def test_a_problem_with_properties_is_solved_and_transformed(hop):
    solved = lambda p: jg.solve(p, SMALL, throw=False)
    e = jg.solve(dataclasses.replace(hop(), half=1.0), SMALL)
    assert float(e.final_time) == 2.0 and e.problem.final_time == 2.0
    np.testing.assert_allclose(e.objective, 6 / 8, rtol=1e-9)
    by = lambda half, lead: solved(hop(half=half, lead=lead)).objective
    cost, slopes = once(jax.value_and_grad(by, argnums=(0, 1)))(0.5, 0.5)
    np.testing.assert_allclose((cost, *slopes), (1.5, -9.0, -6.0), rtol=1e-7)
    mapped = jax.vmap(lambda p: solved(p).objective)(jax.vmap(hop)(jnp.array([0.5, 1.0])))
    np.testing.assert_allclose(mapped, [6, 6 / 8], rtol=1e-9)


def test_properties_and_subclasses():
    class Twice(DoubleIntegrator):
        @property
        def final_time(self):
            return 2 * self.k

    class Fixed(Twice):  # a plain value over a property: a field again
        final_time = 3.0

    class Again(Fixed):
        @property
        def final_time(self):
            return 4 * self.k

    class FromOutside:
        @property
        def final_time(self):
            return 5 * self.k

    class Mixed(FromOutside, DoubleIntegrator):
        pass

    assert [p(k=1.5).final_time for p in (Twice, Fixed, Again, Mixed)] == [3.0, 3.0, 6.0, 7.5]
    assert dataclasses.replace(Fixed(), final_time=4.0).final_time == 4.0
    for kind in (Twice, Again, Mixed):
        with pytest.raises(TypeError, match="final_time"):
            dataclasses.replace(kind(), final_time=4.0)

    class Started(DoubleIntegrator):
        @property
        def initial_state(self):
            return (self.k, 0.0)

    with pytest.raises(TypeError, match="Listed.initial_state is a list, but a property of Start"):

        class Listed(Started):
            initial_state = [0.0, 0.0]


# Refusals: each names the field, its value and the remedy -------------------------------------


def refusal(problem) -> str:
    with pytest.raises(ValueError) as caught:
        validate(problem)
    return str(caught.value)


@pytest.mark.parametrize("name", ["state_names", "control_names"])
@pytest.mark.parametrize("value", [(), "xv", ["x", "v"]], ids=["missing", "string", "list"])
def test_refuses_names(name, value):
    message = refusal(dataclasses.replace(Base(), **{name: value}))
    assert f"Base.{name}" in message and repr(value) in message and "tuple of strings" in message


def test_refuses_repeated_names():
    message = refusal(dataclasses.replace(Base(), state_names=("x", "x")))
    assert "Base.state_names" in message and "'x', 'x'" in message and "repeats" in message


WRONG_SHAPES = {
    "dynamics": (lambda self, t, x, u: jnp.zeros(3), "(3,)", "(2,)"),
    "running_cost": (lambda self, t, x, u: u**2, "(1,)", "scalar"),
    "endpoint_cost": (lambda self, x0, xf, t0, tf: xf, "(2,)", "scalar"),
    "endpoint_constraints": (lambda self, x0, xf, t0, tf: xf[0], "()", "jnp.stack"),
    "path_constraints": (lambda self, t, x, u: x[0], "()", "jnp.stack"),
    "integrands": (lambda self, t, x, u: x[0], "()", "jnp.stack"),
    "optimal_control": (lambda self, t, x, c: -c, "(2,)", "(1,)"),
}


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_refuses_wrong_shapes(name):
    method, got, remedy = WRONG_SHAPES[name]
    Bad = type("Bad", (Base,), {name: method})
    message = refusal(Bad())
    assert f"Bad.{name}" in message and got in message and remedy in message


def test_refuses_a_method_that_cannot_be_evaluated():
    class Bad(Base):
        def dynamics(self, t, x, u):
            return jnp.stack([x[1], jnp.dot(x, jnp.ones(5))])

    message = refusal(Bad())
    assert "Bad.dynamics" in message and "a state of 2" in message


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("state_bounds", ((0.0, 2.0), (1.0, 1.0)), ("component 1", "2.0", "1.0", "exchange")),
        ("control_bounds", (1.0, -1.0), ("component 0", "1.0", "-1.0", "exchange")),
        ("control_bounds", (math.nan, 1.0), ("component 0", "nan", "NaN")),
        ("endpoint_bounds", ((0.0, 0.0), (0.0, -1.0)), ("component 1", "-1.0")),
        ("control_bounds", 1.0, ("1.0", "(lower, upper)")),
        ("control_bounds", (0.0, 1.0, 2.0), ("(lower, upper)",)),
        ("state_bounds", ((0.0, 0.0, 0.0), 1.0), ("does not broadcast", "2 components")),
    ],
)
def test_refuses_bounds(name, value, words):
    message = refusal(dataclasses.replace(DoubleIntegrator(), **{name: value}))
    assert f"DoubleIntegrator.{name}" in message
    for word in words:
        assert word in message


def test_refuses_crossed_path_and_integral_bounds():
    class Bounded(Base):
        def path_constraints(self, t, x, u):
            return x

        def integrands(self, t, x, u):
            return x

    for name in ("path_bounds", "integral_bounds"):
        message = refusal(Bounded(**{name: (1.0, 0.0)}))
        assert f"Bounded.{name}" in message and "exchange" in message


def test_free_refuses_crossed_limits():
    with pytest.raises(ValueError, match=r"lo=2.0 lies above hi=1.0; exchange"):
        jg.Free(2.0, 1.0)
    with pytest.raises(ValueError, match="exchange"):
        jg.Free(math.nan, 1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_refuses_an_initial_state_that_is_not_finite(bad):
    message = refusal(dataclasses.replace(DoubleIntegrator(), initial_state=(0.0, bad)))
    assert "initial_state" in message and "v is" in message and str(bad) in message
    assert "finite number" in message and "jg.Free()" in message


def test_refuses_a_free_state_whose_guess_is_not_finite():
    message = refusal(Base(initial_state=(0.0, jg.Free(guess=math.nan))))
    assert "v is nan" in message and "guess" in message


@pytest.mark.parametrize("entries", [(0.0,), (0.0, 0.0, 0.0), np.zeros(3)])
def test_refuses_an_initial_state_of_the_wrong_length(entries):
    message = refusal(dataclasses.replace(DoubleIntegrator(), initial_state=entries))
    assert f"{len(entries)} entries for 2 states" in message and "('x', 'v')" in message


def test_refuses_an_initial_state_that_is_a_lone_number():
    message = refusal(dataclasses.replace(DoubleIntegrator(), initial_state=1.0))
    assert "initial_state" in message and "2 states" in message


@pytest.mark.parametrize("tf", [0.0, -1.0])
def test_refuses_a_horizon_of_no_length(tf):
    message = refusal(dataclasses.replace(DoubleIntegrator(), final_time=tf))
    assert f"final_time {tf}" in message and "initial_time 0.0" in message and "positive" in message


@pytest.mark.parametrize(
    ("name", "value"),
    [("final_time", math.nan), ("initial_time", math.nan), ("initial_time", -math.inf)],
)
def test_refuses_times_that_are_not_numbers(name, value):
    message = refusal(dataclasses.replace(DoubleIntegrator(), **{name: value}))
    assert name in message and str(value) in message


def test_refuses_a_free_final_time_that_ends_before_the_start():
    message = refusal(dataclasses.replace(Base(), initial_time=5.0, final_time=jg.Free(1.0, 4.0)))
    assert "final_time" in message and "4.0" in message


def test_refuses_dynamics_that_are_nan_at_the_start():
    class Singular(Base):
        initial_state = (0.0, 1.0)

        def dynamics(self, t, x, u):
            return jnp.stack([x[1], 1 / x[0] - 1 / x[0]])

    message = refusal(Singular())
    assert "Singular.dynamics" in message and "d(v)/dt is nan" in message and "x=[0. 1.]" in message


def test_validate_under_a_trace_checks_shapes_but_not_values():
    jax.jit(lambda tf: validate(dataclasses.replace(DoubleIntegrator(), final_time=tf)) or tf)(-1.0)
    with pytest.raises(ValueError, match="initial_state has 3 entries"):
        three = lambda tf: validate(DoubleIntegrator(final_time=tf, initial_state=(0.0, 0.0, 0.0)))
        jax.jit(lambda tf: three(tf) or tf)(1.0)
