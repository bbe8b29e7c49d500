"""Extremals: against independent numbers and closed forms; certificates; derivatives."""

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
from conftest import (
    SMALL,
    DoubleIntegrator,
    ForcedLQR,
    FreeTime,
    Regulator,
    at,
    once,
    slow,
    zermelo_to_go,
)
from scipy import integrate, optimize

import jaxguide as jg
from jaxguide.nominal.indirect.shot import judged
from jaxguide.nominal.roots import differentiable_if, implicit_root
from jaxguide.problems.earth_mars import EarthMars
from jaxguide.reproduce.earth_mars.published import ANGLES, COSTATE_END, COSTATE_START, RADIUS

# Earth-Mars at two times that are no nodes, with the sign of a minimised H; computed without this
# package (see jaxguide/reproduce/earth_mars/published.py, whose numbers have the same source).
BETWEEN = {
    1.0: (
        (1.07567529135545057, 0.18654754702150509, 1.03225292131381051),
        (-1.08364905768737613, -0.62727544628586737, -0.33799623749325370),
    ),
    2.0: (
        (1.35749406043151304, 0.27595235002353990, 0.80291180886766516),
        (-0.95844516862819105, 0.29711637202221336, -0.00528172823740076),
    ),
}
D_RADIUS_D_THRUST = 3.5434202430  # of r(tf), by finite differences of re-solved problems


def failed(certificate):
    return {row["check"]: row for row in certificate.rows() if not row["passed"]}


# Earth-Mars -----------------------------------------------------------------------------------


def test_earth_mars_against_independent_numbers(earth_mars):
    e = earth_mars
    # The reference is good to 1e-13; shooting to 1e-12 of the boundary conditions.
    np.testing.assert_allclose(e.x[-1, 0], RADIUS, rtol=0, atol=1e-10)
    np.testing.assert_allclose(e.objective, -RADIUS, rtol=0, atol=1e-10)
    np.testing.assert_allclose(e.costate[0], COSTATE_START, rtol=0, atol=1e-10)
    np.testing.assert_allclose(e.costate[-1], COSTATE_END, rtol=0, atol=1e-10)
    # nu = costates of (v_r, v_t) at the end, since the constraints are linear in them.
    np.testing.assert_allclose(e.multipliers.endpoint, COSTATE_END[1:], rtol=0, atol=1e-10)
    assert float(e.residual) <= 1e-12
    assert bool(e.result == jg.RESULTS.successful) and float(e.final_time) == 3.32


def test_earth_mars_control_angle_is_unwrapped(earth_mars):
    t = jnp.asarray(list(ANGLES))
    got = np.asarray(at(earth_mars, t).u)[:, 0]
    got = got - 2 * np.pi * np.round((got[0] - ANGLES[0.0]) / (2 * np.pi))
    np.testing.assert_allclose(got, list(ANGLES.values()), rtol=0, atol=1e-10)
    dense = np.asarray(at(earth_mars, jnp.linspace(0, 3.32, 3321)).u)[:, 0]
    # The fastest turn is 19.67 rad/TU (reference file): 0.02 rad over 1e-3 TU.
    assert 0.0195 < np.abs(np.diff(dense)).max() < 0.0198


@pytest.mark.parametrize("t", BETWEEN)
def test_earth_mars_between_nodes(earth_mars, t):
    assert np.abs(np.asarray(earth_mars.t) - t).min() > 1e-6
    point = at(earth_mars, jnp.asarray(t))
    np.testing.assert_allclose(point.x, BETWEEN[t][0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(point.costate, BETWEEN[t][1], rtol=0, atol=1e-10)


def test_extremal_at_nodes_and_beyond(earth_mars):
    e = earth_mars
    some = jnp.array([0, 7, 100, -1])
    points = jax.vmap(lambda t: at(e, t))(e.t[some])
    for got, nodal in ((points.x, e.x), (points.costate, e.costate)):
        np.testing.assert_allclose(got, nodal[some], rtol=0, atol=1e-14)
    for outside, end in ((-1.0, 0), (9.0, -1)):
        held = at(e, jnp.asarray(outside))
        np.testing.assert_allclose(held.x, e.x[end], rtol=0, atol=1e-14)
        # one Newton step on H_u = 0 may move the last digits
        np.testing.assert_allclose(held.u, e.u[end], rtol=0, atol=1e-12)


# Certificates ---------------------------------------------------------------------------------


def test_certificate_passes_and_prints(earth_mars):
    certificate = earth_mars.certificate
    assert bool(jnp.all(certificate.passed))
    text = str(certificate)
    assert "FAILS" not in text and len(text.splitlines()) == len(certificate.names)


BREAK = 12 * 12  # a node shared by two segments of 12th degree
SPOILED = {  # row: how to break it, what and where it must name
    "costate equation": (
        lambda e: e.costate,
        lambda v: v.at[BREAK, 1].add(1e-6),
        "costate of v_r",
        BREAK,
    ),
    "state equation": (lambda e: e.x, lambda v: v.at[BREAK, 2].add(1e-6), "v_t", BREAK),
    "stationarity H_u": (lambda e: e.u, lambda v: v.at[BREAK + 5].add(1e-6), "epsilon", BREAK + 5),
    "transversality, end": (
        lambda e: e.multipliers.endpoint,
        lambda v: v.at[0].add(1e-6),
        "costate of v_r",
        -1,
    ),
    "initial state": (lambda e: e.x, lambda v: v.at[0, 1].add(1e-6), "v_r", 0),
    "endpoint constraints": (lambda e: e.x, lambda v: v.at[-1, 2].add(1e-6), "constraint 1", -1),
    "Legendre-Clebsch": (lambda e: e.u, lambda v: v + jnp.pi, "-min eig H_uu", None),
    "spectral tail, state": (lambda e: e.x, lambda v: v.at[BREAK + 5, 0].add(1e-6), "r", None),
    "control bounds": (
        lambda e: e.problem.control_bounds,
        lambda bounds: tuple(0.5 * jnp.sign(b) for b in bounds),
        "epsilon",
        -1,
    ),
}


@pytest.mark.parametrize("row", SPOILED)
def test_a_spoiled_extremal_fails_in_the_right_row(earth_mars, row):
    where, change, label, node = SPOILED[row]
    spoiled = eqx.tree_at(where, earth_mars, change(where(earth_mars)))
    certificate = spoiled.certificate
    bad = failed(certificate)
    assert row in bad and bad[row]["where"] == label
    if node is not None:  # a shared node spoils both of its segments alike
        near = (node, node + 12) if row.endswith("equation") else (node,)
        assert bad[row]["time"] in [float(earth_mars.t[k]) for k in near]
    line = next(v for v in str(certificate).splitlines() if row in v)
    assert line.startswith("FAILS") and f"{label} at t = " in line


def test_a_nan_fails_its_rows(earth_mars):
    spoiled = eqx.tree_at(lambda e: e.x, earth_mars, earth_mars.x.at[BREAK, 0].set(jnp.nan))
    assert "state equation" in failed(spoiled.certificate)


@pytest.mark.slow
def test_the_costly_row_flies_the_control(earth_mars):
    whole = jg.certify(earth_mars, costly=True)
    assert "propagated state" in whole.names and bool(jnp.all(whole.passed))
    spoiled = eqx.tree_at(lambda e: e.u, earth_mars, earth_mars.u + 1e-4)
    row = failed(jg.certify(spoiled, costly=True))["propagated state"]
    assert row["where"] in EarthMars.state_names and row["value"] > 1e-6


@pytest.mark.slow
def test_a_conjugate_point_fails_its_row():
    # x' = u, J = int (u^2 - x^2)/2 on ends given: conjugate pi before the end.
    for horizon in (3.0, 4.0):
        e = jg.solve(Regulator(q=(-1.0, -0.25), final_time=horizon), SMALL, throw=False)
        row = failed(jg.certify(e, costly=True)).get("conjugate points")
        assert (row is None) == (horizon < np.pi)
        if row is not None:  # told at the break before it
            later = np.asarray(e.breaks)[np.asarray(e.breaks) > row["time"]]
            assert row["time"] < horizon - np.pi <= later[0]


# Single shooting and guesses ------------------------------------------------------------------


@pytest.mark.slow
def test_single_shooting_from_rough_costates(earth_mars):
    rough = jnp.round(earth_mars.costate[0], 1)
    e = jg.solve(EarthMars(), jg.Shooting(arcs=1), guess=rough)
    assert e.residual <= 1e-12
    np.testing.assert_allclose(e.x[-1, 0], RADIUS, rtol=0, atol=1e-10)
    np.testing.assert_allclose(e.costate[0], COSTATE_START, rtol=0, atol=1e-10)


def test_refuses_a_guess_of_the_wrong_shape():
    with pytest.raises(ValueError, match=r"guess has shape \(3,\); give an Extremal or the 2"):
        jg.solve(DoubleIntegrator(), SMALL, guess=jnp.zeros(3))


# Derivatives and batches ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def of_thrust(earth_mars):
    """thrust -> (objective, costate(0), residual, result) of the re-solved Earth-Mars problem,
    by single shooting from the nominal."""
    method = jg.Shooting(arcs=1)

    @eqx.debug.assert_max_traces(max_traces=4)  # a batch, one, and each way of differentiating
    def solve(thrust):
        e = jg.solve(EarthMars(thrust=thrust), method, earth_mars)  # throws nothing: traced
        return e.objective, e.costate[0], e.residual, e.result

    return solve


@pytest.fixture(scope="module")
def batch(of_thrust):
    """100 thrusts within 2 per cent, the last four for finite differences. More than 64: a batch
    of 64 is where vmapped LAPACK calls have hung."""
    h = 1e-3
    thrust = 0.1405 * (1 + 0.02 * np.random.default_rng(0).uniform(-1, 1, 96))
    thrust = jnp.asarray(np.append(thrust, 0.1405 + h * np.array([-2, -1, 1, 2])))
    return h, thrust, eqx.filter_jit(jax.vmap(of_thrust))(thrust)


@pytest.mark.slow
def test_thrust_derivatives_both_ways(of_thrust, batch):
    k = jnp.asarray(0.1405)

    @once
    def both(k):
        value, pull = jax.vjp(lambda k: of_thrust(k)[:2], k)
        tangents = jax.jvp(lambda k: of_thrust(k)[:2], (k,), (jnp.ones_like(k),))[1]
        basis = jnp.eye(4, dtype=k.dtype)
        reverse = jax.vmap(lambda b: pull((b[0], b[1:]))[0])(basis)
        return tangents, reverse

    (d_objective, d_costate), reverse = both(k)
    # The published figure has ten digits after the point.
    np.testing.assert_allclose(d_objective, -D_RADIUS_D_THRUST, rtol=0, atol=1e-9)
    np.testing.assert_allclose(reverse[0], -D_RADIUS_D_THRUST, rtol=0, atol=1e-9)
    np.testing.assert_allclose(reverse[1:], d_costate, rtol=1e-9)
    h, _, (objective, costate, *_) = batch
    # Central differences of fourth order: error h^4 f^(5)/30, some 1e-8 for derivatives that grow
    # by 1/thrust = 7 an order; rounding 1e-12/h = 1e-9.
    five_point = lambda f: (f[-4] - 8 * f[-3] + 8 * f[-2] - f[-1]) / (12 * h)
    np.testing.assert_allclose(d_objective, five_point(objective), rtol=1e-7)
    np.testing.assert_allclose(d_costate, five_point(costate), rtol=1e-7)


def test_vmap_equals_a_loop(of_thrust, batch):
    _, thrust, (objective, costate, residual, result) = batch
    assert float(residual.max()) <= 1e-12  # all 100 converged
    assert set(np.asarray(result._value)) == {int(jg.RESULTS.successful._value)}
    one = eqx.filter_jit(of_thrust)
    for i in (0, 33, 95):
        alone = one(thrust[i])
        np.testing.assert_allclose(objective[i], alone[0], rtol=1e-12)
        np.testing.assert_allclose(costate[i], alone[1], rtol=1e-11)  # conditioning of shooting
    # Under a trace nothing is thrown: the result tells. (And nothing is traced anew.)
    assert bool(one(thrust[0] * jnp.nan)[3] == jg.RESULTS.not_converged)


@pytest.mark.slow
def test_vmap_equals_a_loop_for_all(of_thrust, batch):
    _, thrust, (objective, costate, *_) = batch
    one = eqx.filter_jit(of_thrust)
    for i, k in enumerate(thrust):
        alone = one(k)
        np.testing.assert_allclose(objective[i], alone[0], rtol=1e-12)
        np.testing.assert_allclose(costate[i], alone[1], rtol=1e-11)


def test_new_parameters_compile_nothing(double_integrator, compilations):
    jg.solve(DoubleIntegrator(), SMALL)
    before = compilations()
    e = jg.solve(dataclasses.replace(DoubleIntegrator(), k=3.0, final_time=2.0), SMALL)
    # J = 6 / (k^2 T^3)
    np.testing.assert_allclose(e.objective, 6 / (9 * 8), rtol=1e-12)
    assert compilations() == before


# Closed forms ---------------------------------------------------------------------------------


def test_double_integrator(double_integrator):
    e = double_integrator
    t = np.asarray(e.t)
    np.testing.assert_allclose(e.objective, 6.0, rtol=1e-13)
    np.testing.assert_allclose(e.u[:, 0], 6 - 12 * t, rtol=0, atol=1e-11)
    np.testing.assert_allclose(e.x[:, 0], 3 * t**2 - 2 * t**3, rtol=0, atol=1e-12)
    # H = u^2/2 + lambda . f minimised: lambda_v = -u, lambda_x = -12.
    np.testing.assert_allclose(e.costate[:, 1], 12 * t - 6, rtol=0, atol=1e-11)
    np.testing.assert_allclose(e.costate[:, 0], -12 + 0 * t, rtol=0, atol=1e-11)
    # Ebar = nu . e with e = xf - target: nu = lambda(tf).
    np.testing.assert_allclose(e.multipliers.endpoint, [-12, 6], rtol=0, atol=1e-11)


def test_scales_of_metres_and_seconds(double_integrator):
    """10,000 km in 1,000 s: J = 6 d^2/T^3, and every row still passes."""
    p = dataclasses.replace(DoubleIntegrator(), target=(1e7, 0.0), final_time=1e3)
    e = jg.solve(p, SMALL)
    np.testing.assert_allclose(e.objective, 6e14 / 1e9, rtol=1e-11)
    assert not failed(e.certificate)


def test_free_final_time(free_time):
    tf = 18**0.25
    np.testing.assert_allclose(free_time.final_time, tf, rtol=1e-12)
    np.testing.assert_allclose(free_time.objective, tf + 6 / tf**3, rtol=1e-13)
    assert not failed(free_time.certificate)
    assert "H at the end" in free_time.certificate.names


def test_a_wrong_free_final_time_fails_its_row(free_time):
    # Costates scaled by 1.001 keep H_u = 0 false too, but H(tf) = 0 is what this row is about.
    spoiled = eqx.tree_at(lambda e: e.costate, free_time, free_time.costate * 1.001)
    assert failed(spoiled.certificate)["H at the end"]["time"] == float(free_time.final_time)


@pytest.mark.slow
def test_zermelo_with_newton_found_heading(zermelo):
    assert not zermelo.problem.has_closed_form
    start, end = optimize.fsolve(
        lambda z: zermelo_to_go(*z) - np.array([3.66, -1.86]), np.radians([105, 240]), xtol=1e-13
    )
    heading = np.asarray(zermelo.u[:, 0])
    heading = heading - 2 * np.pi * np.round((heading[0] - start) / (2 * np.pi))
    # Shooting to 1e-12 of the boundary conditions; to go is well conditioned in the headings.
    np.testing.assert_allclose(heading[[0, -1]], [start, end], rtol=0, atol=1e-10)
    np.testing.assert_allclose(zermelo.final_time, np.tan(end) - np.tan(start), rtol=1e-11)
    assert not failed(zermelo.certificate)


@pytest.mark.slow
def test_forced_lqr_with_a_free_component_and_time_in_everything(lqr):
    """Running and endpoint cost, dynamics that depend on time, a start other than 0."""
    p, t0, tf = ForcedLQR(), 0.5, 2.0

    def rates(t, z):  # costate of x = S x + g
        S, g = z
        forcing = S * p.d * np.sin(t) + p.c * np.cos(t)
        return [S * S - 2 * p.a * S - p.q, -(p.a - S) * g - forcing]

    back = integrate.solve_ivp(
        rates, (tf, t0), [p.s, 0.0], method="DOP853", rtol=1e-13, atol=1e-13, dense_output=True
    )
    for i in (0, 40, -1):
        S, g = back.sol(float(lqr.t[i]))
        x, lam = float(lqr.x[i, 0]), float(lqr.costate[i, 0])
        # DOP853's dense output is of seventh order: 1e-10 between its steps.
        np.testing.assert_allclose(lam, S * x + g, rtol=0, atol=1e-9)
        np.testing.assert_allclose(lqr.u[i, 0], -lam, rtol=1e-13)
    forward = integrate.solve_ivp(
        lambda t, x: p.a * x - back.sol(t)[0] * x - back.sol(t)[1] + p.d * np.sin(t),
        (t0, tf), [1.0], method="DOP853", rtol=1e-12, atol=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(lqr.x[-1, 0], forward.y[0, -1], rtol=0, atol=1e-9)
    g = np.exp((tf**2 - t0**2) / 4)
    np.testing.assert_allclose(lqr.x[0], [1.0, 2 * g / (1 + g * g)], rtol=1e-12)
    np.testing.assert_allclose(lqr.x[-1, 1], 2 * g * g / (1 + g * g), rtol=1e-12)
    assert not failed(lqr.certificate) and "transversality, start" in lqr.certificate.names


# Failures -------------------------------------------------------------------------------------


def test_a_contradictory_end_names_its_constraint(double_integrator):
    # x = 1 and x = 2
    p = dataclasses.replace(DoubleIntegrator(), C=(1.0, 0.0, 1.0, 0.0), target=(1.0, 2.0))
    with pytest.raises(jg.SolveError) as caught:
        jg.solve(p, SMALL)
    message = str(caught.value)
    assert "DoubleIntegrator" in message and "ndpoint constraint" in message and "relax" in message


@pytest.mark.parametrize("r", [(1.0, -1.0), (1.0, 0.0)], ids=["negative", "singular"])
@pytest.mark.slow
def test_controls_that_do_not_minimise_are_refused(regulator, r):
    with pytest.raises(jg.SolveError, match="H_uu|boundary conditions"):
        jg.solve(dataclasses.replace(Regulator(), r=r), SMALL)


def test_a_root_that_is_none_has_no_derivative():
    def root(a):
        missed = lambda y, a: y**2 - a
        y = implicit_root(missed, jnp.full(1, 3.0), a, 1e-14, 40)
        return differentiable_if(jnp.abs(missed(y, a)[0]) < 1e-12, y, a)[0]

    a = jnp.array([4.0, jnp.nan, -1.0, 9.0])  # a square root, nothing, none, another one
    for gradient in (jax.grad(root), jax.jacfwd(root)):
        slope = jax.jit(jax.vmap(gradient))(a)
        np.testing.assert_allclose(slope, [1 / 4, jnp.nan, jnp.nan, 1 / 6], rtol=1e-14)
    curvature = jax.vmap(jax.grad(jax.grad(root)))(a)
    np.testing.assert_allclose(curvature, [-1 / 32, jnp.nan, jnp.nan, -1 / 108], rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(root)(a[::3]), [2.0, 3.0], rtol=1e-15)


@pytest.mark.slow
def test_a_failure_in_a_batch_spoils_only_its_own_gradient(earth_mars):
    def radius(thrust):
        e = jg.solve(EarthMars(thrust=thrust), SMALL, guess=earth_mars)
        return e.x[-1, 0]

    thrust = EarthMars().thrust
    batch = jnp.array([thrust, jnp.nan, 0.0, thrust])  # without thrust the end is out of reach
    slope = once(jax.vmap(jax.grad(radius)))(batch)
    # The reference is a finite difference, good to some 1e-9.
    np.testing.assert_allclose(slope[::3], D_RADIUS_D_THRUST, rtol=1e-8)
    assert np.all(np.isnan(slope[1:3]))


@pytest.mark.slow
def test_not_minimising_is_told_apart(earth_mars):
    e, size = earth_mars, earth_mars.sizes()
    judge = once(lambda u: judged(dataclasses.replace(e, u=u), size, e.residual))
    assert bool(judge(e.u) == jg.RESULTS.successful)
    assert bool(judge(e.u + jnp.pi) == jg.RESULTS.not_minimising)  # H maximised


@pytest.mark.slow
def test_violated_bounds_are_flagged(double_integrator):
    p = dataclasses.replace(DoubleIntegrator(), control_bounds=(-2.0, 2.0))
    with pytest.raises(jg.SolveError, match="bounds"):
        jg.solve(p, SMALL)
    e = jg.solve(p, SMALL, throw=False)
    assert bool(e.result == jg.RESULTS.bounds_violated)
    assert list(failed(e.certificate)) == ["control bounds"]
    p = dataclasses.replace(DoubleIntegrator(), state_bounds=(-1.0, (2.0, 1.0)))  # v reaches 1.5
    e = jg.solve(p, SMALL, throw=False)
    assert bool(e.result == jg.RESULTS.bounds_violated)
    assert failed(e.certificate)["state bounds"]["where"] == "v"


def test_float32_is_refused(double_integrator):
    with jax.enable_x64(False):
        with pytest.raises(RuntimeError, match="float64.*jax_enable_x64"):
            jg.solve(DoubleIntegrator(), SMALL)
        with pytest.raises(RuntimeError, match="float64.*jax_enable_x64"):
            jg.gain_schedule(double_integrator, np.array([0.0, 0.5]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"arcs": 3}, "segments=32 must be a multiple of arcs=3"),
        ({"arcs": 0}, "arcs=0"),
        ({"starts": 0}, "starts=0"),
        ({"segments": 0}, "segments=0"),
        ({"degree": 0}, "degree=0"),
        ({"tolerance": -1.0}, "tolerance=-1.0"),
    ],
)
def test_refuses_options(options, words):
    with pytest.raises(ValueError, match=words):
        jg.Shooting(**options)


class Integrals(DoubleIntegrator):
    def integrands(self, t, x, u):
        return u


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (DoubleIntegrator(k=jg.Free(0.5, 2.0)), "DoubleIntegrator.k is a jg.Free"),
        (DoubleIntegrator(final_time=math.inf), "final_time is infinite"),
        (DoubleIntegrator(endpoint_bounds=(-1.0, 0.0)), "constraint 0 is an inequality"),
        (Integrals(), "Integrals.integrands"),
    ],
)
def test_refuses_what_shooting_cannot_do(problem, words):
    with pytest.raises(ValueError, match=words):
        jg.solve(problem, SMALL)


def test_solve_refuses_a_bad_problem_at_once():
    with pytest.raises(ValueError, match="final_time 0.0 is not after"):
        jg.solve(FreeTime(final_time=0.0))


@pytest.mark.parametrize("method", [SMALL, slow(jg.PiecewiseLinear(3, starts=4))])
@pytest.mark.parametrize(("length", "time"), [(1e-9, 1.0), (1e-4, 1e-4), (1e7, 1e3), (1.0, 1e6)])
def test_any_units_of_smooth_problems(method, length, time):
    """x'' = u over `length` in `time`: J = 6 length^2/time^3. Each program is compiled once."""
    start, target = (0.0, 0.0), (jnp.asarray(length), jnp.asarray(0.0))
    p = DoubleIntegrator(target=target, initial_state=start, final_time=jnp.asarray(time))
    e = jg.solve(p, method)
    # Of a polynomial that either method represents exactly, rounding remains.
    np.testing.assert_allclose(e.objective, 6 * length**2 / time**3, rtol=1e-12)
    assert np.all(e.certificate.passed), str(e.certificate)


def test_a_final_time_outside_its_own_bounds_is_no_success(free_time):
    """Shooting does not enforce the bounds of a free final time: 18^(1/4) = 2.06 is below 3."""
    e = jg.solve(FreeTime(final_time=jg.Free(3.0, 20.0, 4.0)), SMALL, throw=False)
    assert bool(e.result == jg.RESULTS.bounds_violated)
