"""Gains against independent numbers, closed forms, transition matrices and re-solved problems."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportAssignmentType=false

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    SMALL,
    DoubleIntegrator,
    ForcedLQR,
    Regulator,
    at,
    flags,
    gain,
    history,
    zermelo_to_go,
)
from scipy.integrate import solve_ivp

import jaxguide as jg
from jaxguide.neighboring import gains as gains_module

DI_LEFT = np.array([1.0, 0.75, 0.5, 0.1, 1e-2, 1e-3])


@pytest.fixture(scope="module")
def di_schedule(double_integrator):
    return jg.gain_schedule(double_integrator, 1 - DI_LEFT, parameters=("k",))


def test_double_integrator_to_the_last_millisecond(di_schedule):
    T = 1 - np.asarray(di_schedule.times)  # of the times as rounded
    want = np.stack([-6 / T**2, -4 / T], axis=1)
    error = np.abs(di_schedule.K[:, 0] - want).max(axis=1) / np.abs(want).max(axis=1)
    assert np.all(error[T >= 0.1] <= 1e-9)
    assert error[4] <= 1e-6 and error[5] <= 1e-4
    # Below the size of the last segment the estimate must still cover what is lost.
    assert np.all((np.asarray(di_schedule.error) >= error) | (error <= 1e-10))


def test_double_integrator_parameters_and_target(di_schedule):
    T = DI_LEFT[:4]
    e = di_schedule.extremal
    x = np.asarray(at(e, jnp.asarray(1 - T)).x)
    # k u = 6 (d - x)/T^2 - (4 v + 2 w)/T to reach (d, w).
    u = 6 * (1 - x[:, 0]) / T**2 - 4 * x[:, 1] / T
    np.testing.assert_allclose(di_schedule.K_parameters[:4, 0, 0], -u, rtol=1e-8, atol=1e-8)
    want = np.stack([6 / T**2, -2 / T], axis=1)
    np.testing.assert_allclose(di_schedule.K_target[:4, 0], want, rtol=1e-8)
    np.testing.assert_array_equal(di_schedule.dtf_dx, np.zeros((6, 2)))  # tf is fixed


def test_double_integrator_history_to_the_end(di_schedule):
    for start in (0.0, 0.25, 0.9):
        for t in (start, 0.95, 1.0):
            T, s = 1 - start, t - start
            want = [-6 / T**2 + 12 * s / T**3, -4 / T + 6 * s / T**2]
            got = history(di_schedule, jnp.asarray(start), jnp.asarray(t))[0]
            np.testing.assert_allclose(got, want, rtol=1e-8, atol=1e-8 * 6 / T**2)


@pytest.mark.parametrize("method", ["least_squares", "square"])
def test_double_integrator_collocated(double_integrator, method):
    # The solution is a cubic: 9 points hold it exactly.
    s = jg.gain_schedule(double_integrator, 1 - DI_LEFT, method, nodes=9)
    T = 1 - np.asarray(s.times)
    want = np.stack([-6 / T**2, -4 / T], axis=1)
    error = np.abs(s.K[:, 0] - want).max(axis=1) / np.abs(want).max(axis=1)
    assert np.all(error[:4] <= 1e-10) and error[4] <= 1e-6 and error[5] <= 1e-4
    np.testing.assert_allclose(
        history(s, jnp.asarray(0.25), jnp.asarray(1.0))[0], [6 / 0.75**2, 2 / 0.75], rtol=1e-8
    )
    np.testing.assert_allclose(gain(s, jnp.asarray(0.6))[0], [-6 / 0.4**2, -4 / 0.4], rtol=1e-8)


def riccati(p, T):
    """S of S' = -2 a S + S^2 - q, S = s at the end, T before it."""
    w = np.sqrt(p.a**2 + p.q)
    c = (p.s - p.a - w) / (p.s - p.a + w) * np.exp(-2 * w * T)
    return p.a + w * (1 + c) / (1 - c)


LQR_TIMES = 0.5 + np.array([0.0, 0.4, 1.0, 1.4, 1.49, 1.4999])


def test_scalar_lqr(lqr):
    s = jg.gain_schedule(lqr, LQR_TIMES)
    # No constraint at the end, so nothing is lost there.
    np.testing.assert_allclose(s.K[:, 0, 0], -riccati(ForcedLQR(), 2 - LQR_TIMES), rtol=1e-10)
    np.testing.assert_allclose(s.K[:, 0, 1], 0, atol=1e-12)  # y drives nothing
    assert s.K_target.shape == (6, 1, 0) and bool(s.resolved.all())


REGULATOR_PARTS = np.array([0.0, 0.1, 0.2, 0.22, 0.3, 0.75, 0.98])  # of the horizon


def regulated(regulator, times=None, **changes):
    problem = dataclasses.replace(Regulator(), **changes)
    e = jg.solve(problem, SMALL, throw=False)
    return jg.gain_schedule(e, REGULATOR_PARTS * problem.final_time)


@pytest.mark.slow
def test_two_controls_against_closed_forms(regulator):
    a, q = np.array([0.5, -0.3]), np.array([2.0, 0.5])
    s = regulated(regulator, a=tuple(a), q=tuple(q))
    w, T = np.sqrt(a**2 + q), (1 - REGULATOR_PARTS)[:, None]
    want = -(a + w / np.tanh(w * T))
    np.testing.assert_allclose(np.diagonal(s.K, axis1=1, axis2=2), want, rtol=1e-8)
    off = np.stack([s.K[:, 0, 1], s.K[:, 1, 0]])
    np.testing.assert_allclose(off, 0, atol=1e-8)
    assert bool(s.resolved.all())


def test_a_long_unstable_horizon_keeps_its_gain(regulator):
    # e^40 = 2e17: without normalising, the rows are lost altogether.
    s = regulated(regulator, a=(1.0, 1.0), q=(0.0, 1.0), final_time=40.0, initial_state=(0.0, 0.0))
    a, w, T = 1.0, np.sqrt([1.0, 2.0]), 40 * (1 - REGULATOR_PARTS)[:, None]
    want = -(a + w / np.tanh(w * T))
    got = np.diagonal(s.K, axis1=1, axis2=2)
    # 64 segments for 40 time constants resolve to the schedule's own default tolerance at least.
    np.testing.assert_allclose(got, want, rtol=1e-6)
    assert bool(s.resolved.all())


@pytest.mark.parametrize(
    "q", [(-1.0, -0.25), (-1.0, -1.0), (-1.0, -1.0001)], ids=["simple", "double", "close pair"]
)
def test_conjugate_points_are_flagged(regulator, q):
    # x' = u, J = int (u^2 - w^2 x^2)/2, ends given: conjugate pi/w before the end.
    s = regulated(regulator, q=q, final_time=4.0)
    T = 4 * (1 - REGULATOR_PARTS)
    w = np.sqrt(-np.array(q))
    ahead = np.any(w * T[:, None] > np.pi, axis=1)
    assert ahead.tolist() == [True, True, True, False, False, False, False]
    assert flags(s) == ["conjugate_point" if c else "successful" for c in ahead]
    np.testing.assert_array_equal(s.resolved, ~ahead)
    want = -w / np.tan(w * T[~ahead][:, None])
    np.testing.assert_allclose(np.diagonal(s.K[3:], axis1=1, axis2=2), want, rtol=1e-6)


@pytest.mark.parametrize("r", [(1.0, -1.0), (1.0, 0.0)], ids=["negative", "singular"])
def test_a_control_cost_that_does_not_minimise_is_flagged(regulator, r):
    spoiled = eqx.tree_at(lambda e: e.problem.r, regulator, tuple(jnp.asarray(v) for v in r))
    s = jg.gain_schedule(spoiled, REGULATOR_PARTS)
    assert not bool(s.resolved.any()) and set(flags(s)) == {"not_minimising"}


def test_active_bounds_are_flagged(double_integrator):
    at_bound = eqx.tree_at(
        lambda e: e.problem.control_bounds, double_integrator, (jnp.asarray(-6.0), jnp.asarray(6.0))
    )
    s = jg.gain_schedule(at_bound, 1 - DI_LEFT)
    np.testing.assert_array_equal(s.bound_active, [True, False, False, False, False, False])


LENGTH, TIME, CONTROL = 1e-7, 1e3, 1e-9


class SmallUnits(DoubleIntegrator):
    """The double integrator in lengths of 1e-7, times of 1e3 and controls of 1e-9: u runs from
    6e-9 to -6e-9. Beside it p' = w, of which w would be 0 but is at least 2e-9."""

    k: float = LENGTH / (TIME**2 * CONTROL)
    target = (LENGTH, 0.0)
    state_names = ("x", "v", "p")
    control_names = ("u", "w")
    initial_state = (0.0, 0.0, 0.0)
    final_time = TIME
    control_bounds = (-10 * CONTROL, 10 * CONTROL)  # reached nowhere: they tell the size
    path_bounds = (2 * CONTROL, jnp.inf)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], self.k * u[0], u[1]])

    def running_cost(self, t, x, u):
        return 0.5 * jnp.sum((u / CONTROL) ** 2) / TIME

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf[:2] - jnp.stack(self.target)

    def path_constraints(self, t, x, u):
        return u[1:]


@pytest.mark.slow
def test_controls_of_any_size_between_nodes():
    """Nothing is small or large by its number alone: w stays on its constraint between nodes."""
    e = jg.solve(SmallUnits(), jg.Pseudospectral(nodes=4, segments=2, refinements=0))
    exact = lambda s: CONTROL * np.stack([6 - 12 * s, np.full_like(s, 2.0)], axis=1)
    costates = lambda s: np.stack([-12 + 0 * s, TIME * (12 * s - 6), 0 * s], axis=1) / LENGTH
    np.testing.assert_allclose(e.u, exact(e.t / TIME), rtol=0, atol=1e-7 * CONTROL)  # the barrier
    nodes, ends = np.asarray(e.t) / TIME, np.asarray(e.breaks[1:]) / TIME
    e = dataclasses.replace(
        e,
        u=jnp.asarray(exact(nodes)),
        u_before=jnp.asarray(exact(ends)),
        costate=jnp.asarray(costates(nodes)),
        costate_before=jnp.asarray(costates(ends)),
    )
    s = np.array([0.0, 0.07, 0.3, 0.5, 0.61, 0.95, 1.0])
    u = at(e, jnp.asarray(TIME * s)).u
    np.testing.assert_allclose(u, exact(s), rtol=0, atol=1e-9 * CONTROL)


@pytest.mark.slow
def test_bounds_of_any_size_are_flagged(double_integrator):
    class Scaled(DoubleIntegrator):
        k: float = LENGTH / (TIME**2 * CONTROL)
        target = (LENGTH, 0.0)
        final_time = TIME

        def running_cost(self, t, x, u):
            return 0.5 * (u[0] / CONTROL) ** 2 / TIME

    e, times = jg.solve(Scaled(), SMALL), TIME * np.array([0.0, 0.2, 0.5, 0.9])
    for name, width, active in (
        ("control_bounds", 6.1 * CONTROL, [False, False, False, False]),
        ("control_bounds", 5.0 * CONTROL, [True, False, False, False]),  # |6 - 12 s| > 5
        ("state_bounds", (1.1 * LENGTH, 1.1 * LENGTH / TIME), [False, False, True, False]),
    ):
        bounds = jnp.asarray(width)
        bounded = dataclasses.replace(e.problem, **{name: (-bounds, bounds)})
        s = jg.gain_schedule(dataclasses.replace(e, problem=bounded), times)
        np.testing.assert_array_equal(s.bound_active, active)
        assert bool(s.resolved.all())


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_a_polished_control_is_near_in_its_own_size(unit):
    """u (1 - u^2/3)-like: H = (u^2/2 - u^4/12)/unit^2 has H_u = 0 at 0 and at sqrt(3) units."""
    from jaxguide.conditions.control import polish_control

    class Quartic(DoubleIntegrator):
        def running_cost(self, t, x, u):
            return 0.5 * (u[0] / unit) ** 2 - (u[0] / unit) ** 4 / 12

    zero, one = jnp.zeros(2), jnp.ones(1) * unit
    polish = lambda u, force: polish_control(
        Quartic(), 0.0, zero, u * one, zero, jnp.zeros(0), force * jnp.ones(1) / unit, one
    )
    # One step from u leaves u^3 of order 1e-11; from 0.1 it would be longer than 1e-3 of the size.
    np.testing.assert_allclose(polish(2e-4, 0.0), 0.0, rtol=0, atol=1e-11 * unit)
    np.testing.assert_array_equal(polish(0.1, 0.0), 0.1 * one)
    np.testing.assert_array_equal(polish(2e-4, 1e-6), 2e-4 * one)  # a constraint holds it


def test_free_final_time_against_a_closed_form(free_time):
    # From (x, v) with T left: u = 6 d/T^2 - 4 v/T, d = 1 - x, where T minimises
    # T + 6 d^2/T^3 - 6 d v/T^2 + 2 v^2/T: c(d, v, T) = 0 below.
    tf = 18**0.25
    times = tf - np.array([1.0, 0.75, 0.5, 0.1, 1e-2, 1e-3]) * tf
    s = jg.gain_schedule(free_time, times)
    x, v = np.asarray(at(free_time, jnp.asarray(times)).x).T
    T, d = tf - times, 1 - x
    c_d = -36 * d / T**4 + 12 * v / T**3
    c_v = 12 * d / T**3 - 4 * v / T**2
    c_T = 72 * d**2 / T**5 - 36 * d * v / T**4 + 4 * v**2 / T**3
    T_x, T_v = c_d / c_T, -c_v / c_T  # d falls as x rises
    u_T = -12 * d / T**3 + 4 * v / T**2
    want = np.stack([-6 / T**2 + u_T * T_x, -4 / T + u_T * T_v], axis=1)
    error = np.abs(s.K[:, 0] - want).max(axis=1) / np.abs(want).max(axis=1)
    # d itself is a small difference near the end: the formula loses (T/tf)^-2 eps of its own.
    assert np.all(error <= [1e-9, 1e-9, 1e-9, 1e-8, 1e-6, 1e-4]), error
    np.testing.assert_allclose(s.dtf_dx[:3], np.stack([T_x, T_v], axis=1)[:3], rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_free_final_time_against_re_solved(free_time):
    s = jg.gain_schedule(free_time, 18**0.25 * np.linspace(0, 0.9, 6))
    h = 1e-4
    for i in range(2):
        up, down = (
            jg.solve(
                dataclasses.replace(
                    free_time.problem, initial_state=tuple(sign * h * np.eye(2)[i])
                ),
                SMALL,
            )
            for sign in (1, -1)
        )
        # h^2 f'''/6 with derivatives of order 10 to 100: 1e-7; rounding 1e-14/h = 1e-10.
        np.testing.assert_allclose(
            s.K[0, 0, i], (up.u[0, 0] - down.u[0, 0]) / (2 * h), rtol=1e-6, atol=1e-9
        )
        np.testing.assert_allclose(
            s.dtf_dx[0, i], (up.final_time - down.final_time) / (2 * h), rtol=1e-6, atol=1e-9
        )


def test_zermelo_shortest_time_against_bryson_ho(zermelo):
    """Position to go is a function of the present and final headings; its inverse Jacobian is K."""
    to_go = lambda z: zermelo_to_go(z[0], z[1], jnp)
    times = float(zermelo.final_time) * np.array([0.0, 0.2, 0.5, 0.7, 0.9, 0.99])
    s = jg.gain_schedule(zermelo, times)
    end = zermelo.u[-1, 0]
    for i, t in enumerate(times):
        point = at(zermelo, jnp.asarray(t))
        heading = point.u[0]
        z = jnp.stack([heading, end])
        np.testing.assert_allclose(to_go(z), point.x, rtol=0, atol=1e-9)
        inverse = np.linalg.inv(jax.jacfwd(to_go)(z))
        # The log and secants are singular at 90 and 270 degrees only; near the end 1/T is lost.
        np.testing.assert_allclose(s.K[i, 0], inverse[0], rtol=1e-7, atol=1e-8)
        slope = np.array([-1 / np.cos(heading) ** 2, 1 / np.cos(end) ** 2])  # of the time to go
        np.testing.assert_allclose(s.dtf_dx[i], slope @ inverse, rtol=1e-7, atol=1e-8)


class Crossing(jg.Problem):
    """As far downstream as possible in fixed time, landing at y = 0.4: a user's ten lines."""

    state_names = ("x", "y")
    control_names = ("heading",)
    initial_state = (0.0, 0.0)
    final_time = 2.0

    def dynamics(self, t, x, u):
        current = jnp.stack([0.6 * x[1] ** 2, 0.5 * jnp.sin(x[0])])
        return current + jnp.stack([jnp.cos(u[0]), jnp.sin(u[0])])

    def endpoint_cost(self, x0, xf, t0, tf):
        return -xf[0]

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf[1:] - 0.4


@pytest.mark.slow
def test_zermelo_fixed_time_against_its_transition_matrix():
    e = jg.solve(Crossing(), jg.Shooting(arcs=2, segments=16, starts=16))
    times = np.array([0.0, 0.5, 1.0, 1.5, 1.9])
    s = jg.gain_schedule(e, times)

    def rates(t, z):
        """Canonical equations of (x, y, l, k) and their variation, by hand, DOP853."""
        x, y, l, k = z[:4]
        size = np.hypot(l, k)  # cos = -l/size, sin = -k/size minimise H
        f = [0.6 * y**2 - l / size, 0.5 * np.sin(x) - k / size, -0.5 * k * np.cos(x), -1.2 * l * y]
        B = np.array([[-k * k, k * l], [k * l, -l * l]]) / size**3
        J = np.zeros((4, 4))
        J[0, 1], J[1, 0] = 1.2 * y, 0.5 * np.cos(x)
        J[:2, 2:] = B
        J[2, 0], J[2, 3] = 0.5 * k * np.sin(x), -0.5 * np.cos(x)
        J[3, 1], J[3, 2] = -1.2 * l, -1.2 * y
        return np.concatenate([f, (J @ z[4:].reshape(4, 4)).ravel()])

    for i, t in enumerate(times):
        point = at(e, jnp.asarray(t))
        z = np.concatenate([point.x, point.costate, np.eye(4).ravel()])
        end = solve_ivp(rates, (t, 2.0), z, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        np.testing.assert_allclose(end[[1, 2]], [0.4, -1.0], rtol=0, atol=1e-10)  # landing, l = -1
        phi = end[4:].reshape(4, 4)[[1, 2]]  # y and the costate of x are given at the end
        S = -np.linalg.solve(phi[:, 2:], phi[:, :2])
        l, k = point.costate
        K = np.array([-k, l]) / (l * l + k * k) @ S  # heading = arctan2(-k, -l)
        np.testing.assert_allclose(s.K[i, 0], K, rtol=1e-9, atol=1e-9)


# Refusals, transformations --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ([0.5, 0.2], r"ascend: times\[0\] = 0.5, times\[1\] = 0.2"),
        ([0.2, 0.2], "ascend"),
        ([-0.1, 0.5], r"span \[-0.1, 0.5\], outside"),
        ([0.5, 1.0], "stop short of it"),
        ([0.0, np.nan], "nan; give finite"),
        ([], r"shape \(0,\)"),
        (0.5, r"shape \(\); give a vector"),
    ],
)
def test_refuses_times(double_integrator, times, words):
    with pytest.raises(ValueError, match=words):
        jg.gain_schedule(double_integrator, times)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "riccati"}, "'riccati'; choose one of segmented, least_squares, square"),
        ({"segments": 12}, "segments is 12; give a positive multiple of 8"),
        ({"segments": 0}, "segments is 0"),
        ({"nodes": 2}, "nodes is 2; give at least 3"),
        ({"sweeps": 0}, "sweeps is 0"),
        ({"parameters": ("mass",)}, "'mass' is not a scalar parameter of DoubleIntegrator"),
        ({"parameters": ("target",)}, "'target' is not a scalar parameter"),
    ],
)
def test_refuses_options(double_integrator, options, words):
    with pytest.raises(ValueError, match=words):
        jg.gain_schedule(double_integrator, [0.0, 0.5], **options)


def test_a_schedule_passes_through_jit(di_schedule):
    leaves = jax.tree_util.tree_leaves(di_schedule)
    assert all(eqx.is_array(leaf) for leaf in leaves)
    got = jax.jit(lambda s, t: (s, s(t)))(di_schedule, jnp.asarray(0.5))
    np.testing.assert_allclose(got[1][0], [-24.0, -8.0], rtol=1e-8)
    np.testing.assert_array_equal(got[0].K, di_schedule.K)


@pytest.mark.slow
def test_gains_differentiate_through_the_solve():
    method = jg.Shooting(arcs=1, segments=4, starts=1)

    def gain(k):
        e = jg.solve(dataclasses.replace(DoubleIntegrator(), k=k), method)
        return jg.gain_schedule(e, jnp.array([0.0, 0.5]), segments=8).K[1, 0]

    k = jnp.asarray(2.0)
    # K = (-24, -8)/k at T = 1/2
    slope = jax.jit(jax.jacrev(gain))(k)
    np.testing.assert_allclose(slope, [24 / 4, 8 / 4], rtol=1e-6)


def test_the_compiled_sweep_traces_once(lqr, monkeypatch):
    inner = eqx.debug.assert_max_traces(gains_module._segmented.__wrapped__, max_traces=1)
    monkeypatch.setattr(gains_module, "_segmented", eqx.filter_jit(inner))
    for end in (1.0, 1.2, 1.4):
        s = jg.gain_schedule(lqr, np.linspace(0.5, end, 3), segments=8)
        np.testing.assert_allclose(s.K[0, 0, 0], -riccati(ForcedLQR(), 1.5), rtol=1e-6)
