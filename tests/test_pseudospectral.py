"""Direct solutions: the Newton step against dense algebra, closed forms, covectors, failures."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator, FreeTime, once, slow
from jax.flatten_util import ravel_pytree

import jaxguide as jg
from jaxguide import problems
from jaxguide.nominal.direct import newton_system
from jaxguide.nominal.direct.collocation import collocation, left_null
from jaxguide.nominal.direct.elimination import eliminate
from jaxguide.nominal.direct.guess import edges
from jaxguide.nominal.direct.kkt_factor import factorise
from jaxguide.nominal.direct.kkt_step import newton_step
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Equations, Primal
from jaxguide.problem.points import Scale
from jaxguide.problems import EarthMars
from jaxguide.spectral import FAMILIES


@pytest.mark.parametrize("family", FAMILIES)
def test_defects_of_polynomials_vanish(family):
    rule = collocation(family, 7)
    c = np.random.default_rng(0).normal(size=len(rule.main) if family == "lg" else 7)
    x = np.polynomial.polynomial.polyval(rule.support, c)
    f = np.polynomial.polynomial.polyval(rule.nodes, np.polynomial.polynomial.polyder(c))
    # Differentiation matrices of 8 points hold rounding times N^2.
    np.testing.assert_allclose(rule.A @ x - rule.B @ f, 0, atol=1e-12)
    assert np.isclose(rule.w.sum(), 2, rtol=1e-14)


def test_left_null_vector_of_lgl_is_w_times_legendre():
    rule = collocation("lgl", 9)
    v = left_null("lgl", 9)
    wanted = rule.w * np.polynomial.legendre.legval(rule.nodes, np.eye(9)[8])
    np.testing.assert_allclose(v / v[0], wanted / wanted[0], rtol=1e-11)
    np.testing.assert_allclose(v @ rule.A, 0, atol=1e-13)


class Everything(EarthMars):
    """Free times, a free initial component, a static parameter, two path constraints."""

    thrust: object = jg.Free(0.1, 0.2, 0.14)
    final_time = jg.Free(1.0, 5.0, 3.0)
    initial_state = (1.0, 0.0, jg.Free(0.5, 2.0))
    path_bounds = (-1.0, 4.0)

    def path_constraints(self, t, x, u):
        return jnp.stack([x[0] * u[0], x[1] + u[0] ** 2])


@pytest.mark.parametrize(
    ("family", "segments", "points", "knots"), [slow("lgl", 2, 5, ()), ("lg", 3, 4, (1,))]
)
def test_newton_step_against_dense_algebra(family, segments, points, knots):
    ends = [1.0, 3.0, *(1.0,) * (2 if knots else 0)]
    scale = Scale(
        jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5]), jnp.asarray(2.0), jnp.array([0.1]),
        jnp.array([1.0, 2.0]), jnp.array(ends), jnp.asarray(0.7),
    )  # fmt: skip
    fractions = jnp.linspace(0.0, 1.0, segments + 1) ** 1.2
    program = Transcription(Everything(), scale, edges(fractions, knots), family, points)
    times = jnp.array([0.0, 1.6, *(0.5,) * len(knots)])
    size, rng = program.counts, np.random.default_rng(0)
    r = lambda *shape: jnp.asarray(rng.normal(size=shape)) * 0.1
    random = lambda tree: jax.tree_util.tree_map(lambda a: r(*a.shape), tree)
    w = Primal(
        jnp.array([1.0, 0.0, 0.4]), jnp.array([[[1.0, 0.0, 0.3]]]) + r(segments, size.after, 3),
        1 + r(segments, points, 1), times + r(len(times)), jnp.array([1.4]),
        r(segments, points, 2), r(len(ends)),
    )  # fmt: skip
    y = Equations(
        10 * r(segments, len(program.rule.A), 3), 10 * r(segments, points, 2), 10 * r(len(ends))
    )
    sigma, pull = jax.tree_util.tree_map(lambda a: jnp.abs(a) + 0.3, random(w)), random(w)
    no = jax.tree_util.tree_map(lambda a: jnp.zeros(a.shape, bool), w)
    given = no._replace(
        x0=jnp.array([True, True, False]), times=no.times.at[0].set(True),
        end=no.end.at[0].set(True),
    )  # fmt: skip
    delta = jnp.asarray(3.0)

    @jax.jit
    def structured():
        nodes, ends = program.derivatives(w)
        _, c = program.objective_and_residual(w)
        system = newton_system.NewtonSystem(nodes, ends, *program.hessians(w, y), sigma, given)
        parts = eliminate(program, system)
        factor, ok = factorise(program, system, parts, delta, jnp.asarray(5.0))
        objective = newton_system.lagrangian_gradient(
            program, nodes, ends, w, jax.tree_util.tree_map(jnp.zeros_like, y)
        )
        force = jax.tree_util.tree_map(jnp.add, objective, pull)
        load = newton_system.Load(
            force, c._replace(path=c.path + newton_system.COMPLIANCE * y.path)
        )
        return newton_step(program, system, parts, factor, load), ok

    flat, unravel = ravel_pytree(w)
    objective = lambda v: program.objective_and_residual(unravel(v))[0]
    constraints = lambda v: ravel_pytree(program.objective_and_residual(unravel(v))[1])[0]
    y_flat, y_back = ravel_pytree(y)

    @jax.jit
    def dense():
        lagrangian = lambda v: objective(v) + jnp.dot(y_flat, constraints(v))
        return (
            jax.hessian(lagrangian)(flat), jax.jacfwd(constraints)(flat),
            jax.grad(objective)(flat), constraints(flat),
        )  # fmt: skip

    H, A, g, c = (np.asarray(a) for a in dense())
    slack = np.asarray(ravel_pytree(no._replace(path=~no.path, end=~no.end))[0])
    diagonal = np.asarray(ravel_pytree(sigma)[0]) + np.where(slack, 0, delta)
    soft = y_back(jnp.zeros_like(y_flat))._replace(
        path=jnp.full(y.path.shape, newton_system.COMPLIANCE)
    )
    soft = np.asarray(ravel_pytree(soft)[0])
    K = np.block([[H + np.diag(diagonal), A.T], [A, -np.diag(soft)]])
    rhs = -np.concatenate([g + np.asarray(ravel_pytree(pull)[0]), c + soft * np.asarray(y_flat)])
    keep = np.concatenate([~np.asarray(ravel_pytree(given)[0]), np.ones(len(c), bool)])
    wanted = np.zeros(len(rhs))
    wanted[keep] = np.linalg.solve(K[np.ix_(keep, keep)], rhs[keep])
    step, ok = structured()
    assert bool(ok) == (np.sum(np.linalg.eigvalsh(K[np.ix_(keep, keep)]) < 0) == len(c))
    got = np.concatenate([ravel_pytree(step.primal)[0], ravel_pytree(step.dual)[0]])
    # Condition number 1e4 to 1e7 times rounding, relative to the largest entry.
    np.testing.assert_allclose(got, wanted, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize(
    ("grid", "nodes", "segments"),
    [slow("lgl", 9, 1), ("lgr-right", 5, 3)],
)
def test_double_integrator(grid, nodes, segments):
    e = jg.solve(DoubleIntegrator(), jg.Pseudospectral(grid, nodes, segments, refinements=0))
    t = np.asarray(e.t)
    np.testing.assert_allclose(e.objective, 6, rtol=1e-12)
    # Cubic states are exact in both; costates to rounding over the least weight.
    np.testing.assert_allclose(e.x[:, 0], 3 * t**2 - 2 * t**3, atol=1e-11)
    np.testing.assert_allclose(e.u[:, 0], 6 - 12 * t, atol=1e-9)
    wanted = np.stack([np.full_like(t, -12), 12 * t - 6], axis=1)
    np.testing.assert_allclose(e.costate, wanted, atol=1e-8)
    assert np.all(e.certificate.passed), str(e.certificate)


def test_free_final_time():
    e = jg.solve(FreeTime(), jg.Pseudospectral("lg", 6, 2, refinements=0))
    np.testing.assert_allclose(e.final_time, 18**0.25, rtol=1e-9)
    assert np.all(e.certificate.passed), str(e.certificate)


@pytest.mark.slow
def test_static_parameter():
    # J = 6/k^2 falls with k, whose bound it meets; the extremal's Problem holds the number found.
    problem = dataclasses.replace(DoubleIntegrator(), k=jg.Free(0.5, 2.0, 1.0))
    e = jg.solve(problem, jg.Pseudospectral(nodes=6, segments=2, refinements=0))
    # Within 1e-9 of a relaxed bound, and mu = 1e-10 over its multiplier short of it.
    np.testing.assert_allclose(vars(e.problem)["k"], 2.0, rtol=1e-8)
    np.testing.assert_allclose(e.objective, 1.5, rtol=1e-8)
    assert np.all(e.certificate.passed), str(e.certificate)


def test_state_constraint_has_a_multiplier_of_the_right_sign():
    # By default, since there are bounds. Two touches or a boundary arc of x <= 1/9: J = 4.
    problem = problems.get("bryson-denham")
    e = jg.solve(problem, jg.Pseudospectral(refinements=0))
    np.testing.assert_allclose(e.objective, 4, rtol=1e-6)
    assert np.all(np.asarray(e.x[:, 0]) <= 1 / 9 + 1e-8)
    # The bound pushes down: the costate of x only falls, by density or at once, from 18 to -18.
    step = e.degree
    assert e.costate_before is not None
    jumps = e.costate_before[:-1, 0] - e.costate[step:-1:step, 0]
    # Along the boundary the mesh leaves 1e-5 of the costate.
    assert min(float(jumps.min()), float(e.multipliers.state[:, 0].min())) > -36e-5
    np.testing.assert_allclose(e.costate[0, 0] - e.costate[-1, 0], 36, rtol=1e-3)


@pytest.mark.slow  # a program of half a minute
def test_earth_mars_against_shooting(earth_mars):
    method = jg.Pseudospectral(nodes=12, segments=6, refinements=0)
    e = jg.solve(EarthMars(), method)
    # 2.9e-8 is what the mesh leaves; costates are as good as their dual problem's resolution.
    np.testing.assert_allclose(e.objective, earth_mars.objective, atol=1e-7)
    off = np.abs(np.asarray(e.costate) - np.asarray(earth_mars(e.t).costate))
    assert off.max() < 1e-5
    again = jg.solve(EarthMars(), method, guess=earth_mars)
    np.testing.assert_allclose(again.objective, e.objective, rtol=1e-9)
    objective = lambda k: jg.solve(dataclasses.replace(EarthMars(), thrust=k), method).objective
    lanes, slopes = once(jax.vmap(jax.value_and_grad(objective)))(jnp.array([0.1405, 0.141]))
    np.testing.assert_allclose(lanes[0], e.objective, rtol=1e-9)
    # reference/earth_mars.json; the mesh leaves 1e-8 of it.
    np.testing.assert_allclose(slopes[0], -3.5434202430, rtol=1e-7)


@pytest.mark.slow
def test_contradictory_ends_are_infeasible():
    class Torn(DoubleIntegrator):
        def endpoint_constraints(self, x0, xf, t0, tf):
            return jnp.stack([xf[0] - 1.0, xf[0] - 2.0])

    method = jg.Pseudospectral(nodes=4, segments=2)
    e = jg.solve(Torn(), method, throw=False)
    assert not bool(e.result == jg.RESULTS.successful)
    with pytest.raises(jg.SolveError, match=r"Endpoint constraint \d misses"):
        jg.solve(Torn(), method)


@pytest.mark.slow  # four programs
def test_degenerate_bounds_are_flagged():
    """min int (u - k)^2/2 with u <= 1: for k = 1 the bound is just touched, and dx(tf)/dk jumps
    from 1 to 0."""

    class Touch(jg.Problem):
        k: float = 1.0
        state_names = ("x",)
        control_names = ("u",)
        initial_state = (0.0,)
        final_time = 1.0
        control_bounds = (-jnp.inf, 1.0)

        def dynamics(self, t, x, u):
            return u

        def running_cost(self, t, x, u):
            return (u[0] - self.k) ** 2 / 2

    method = jg.Pseudospectral(nodes=4, segments=1, refinements=0)
    flags = [bool(jg.solve(Touch(k=k), method).degenerate) for k in (0.9, 1.0, 1.1)]
    assert flags == [False, True, False]


@pytest.mark.slow  # a program of half a minute; test_bounds.py has each kind of bound once
def test_implicit_derivatives_with_an_active_bound():
    """d tf of a bang-bang landing by gravity, the thrust limit and the initial height, both ways,
    against finite differences of solutions on the same mesh."""

    def landing(gravity, limit, height):
        problem = dataclasses.replace(
            problems.get("moon-lander"), gravity=gravity, control_bounds=(0.0, limit),
            initial_state=(height, -2.0),
        )  # fmt: skip
        method = jg.Pseudospectral(nodes=4, segments=6, refinements=0, tolerance=1e-11)
        return jg.solve(problem, method, throw=False).final_time

    at, h = (1.5, 3.0, 10.0), 1e-5

    @once
    def both(*at):
        _, push = jax.linearize(landing, *at)  # one solve for both ways
        pull = jax.linear_transpose(push, *at)
        return jax.vmap(push)(*jnp.eye(3)), pull(jnp.ones(()))

    forward, backward = both(*map(jnp.asarray, at))
    for i in range(3):
        shift = lambda d, i=i: [a + d * (j == i) for j, a in enumerate(at)]
        slope = (landing(*shift(h)) - landing(*shift(-h))) / (2 * h)
        # Truncation of order h^2 = 1e-10, cancellation of order 1e-11/h = 1e-6 at worst.
        np.testing.assert_allclose(forward[i], slope, rtol=1e-6)
        np.testing.assert_allclose(backward[i], forward[i], rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"grid": "uniform"}, "grid is 'uniform'; choose one of lgl"),
        ({"nodes": 1}, "needs at least 2"),
        ({"segments": 0}, "segments is 0"),
        ({"tolerance": 2.0}, "tolerance is 2.0"),
        ({"refinements": -1}, "refinements is -1"),
        ({"max_iterations": 0}, "max_iterations is 0"),
        ({"mesh_tolerance": 0.0}, "mesh_tolerance is 0.0"),
        ({"fractions": (0.0, 0.7, 0.3, 1.0)}, "ascend from 0 to 1"),
    ],
)
def test_bad_options(options, words):
    with pytest.raises(ValueError, match=words):
        jg.Pseudospectral(**options)


class Endless(jg.Problem):
    """x' = x + u, cost x^2 + u^2, for ever: J = 1 + sqrt 2, u = -(1 + sqrt 2) x."""

    state_names = ("x",)
    control_names = ("u",)
    initial_state = (1.0,)
    final_time = np.inf

    def dynamics(self, t, x, u):
        return x + u

    def running_cost(self, t, x, u):
        return x[0] ** 2 + u[0] ** 2


@pytest.mark.slow
def test_infinite_horizon():
    e = jg.solve(Endless(), jg.Pseudospectral(nodes=20, segments=1, refinements=0))
    # reference/pseudospectral.md: an error of 1e-10 with 20 nodes.
    np.testing.assert_allclose(e.objective, 1 + np.sqrt(2), atol=2e-10)
    assert e.t[-1] == np.inf and e.final_time == np.inf
    t = jnp.array([0.0, 0.5, 2.0, 5.0])
    at = e(t)
    # Pointwise the interpolant of 20 nodes, in s, keeps some six digits.
    np.testing.assert_allclose(at.x[:, 0], np.exp(-np.sqrt(2) * t), atol=2e-6)
    np.testing.assert_allclose(at.costate, 2 * (1 + np.sqrt(2)) * at.x, atol=1e-5)
    np.testing.assert_allclose(at.u, -(1 + np.sqrt(2)) * at.x, atol=1e-5)


@pytest.mark.slow
def test_bounded_infinite_horizon():
    """u = -1.5 until x = 1.5/(1 + sqrt 2), then as above: rates that grow as 1/(1 - s)^2 towards
    the end must not set the objective's size (J was 4.8, and called a solution)."""
    cap, gain = 1.5, 1 + np.sqrt(2)
    end = cap / gain
    time = np.log((cap - end) / (cap - 1))  # x = cap - (cap - 1) e^t
    grown = (cap - end) / (cap - 1)
    squares = cap**2 * time - 2 * cap * (cap - 1) * (grown - 1)
    squares += (cap - 1) ** 2 * (grown**2 - 1) / 2
    e = jg.solve(Endless(control_bounds=(-cap, cap)), jg.Pseudospectral(refinements=0))
    # The switch lies within a segment, 1/12 of the horizon: 3e-6; at its break, 7e-9.
    np.testing.assert_allclose(e.objective, squares + cap**2 * time + gain * end**2, rtol=5e-6)


@pytest.mark.slow
def test_relaxed_dynamics_cost_less():
    method = jg.Pseudospectral(nodes=5, segments=2, refinements=0, relaxation=1e-2)
    e = jg.solve(DoubleIntegrator(), method)
    # J(delta) = 6 - delta (int |lambda_x| + int |lambda_v|) to first order = 6 - 15 delta.
    np.testing.assert_allclose(e.objective, 6 - 15e-2, atol=15e-2 * 0.05)
    assert e.u.shape[1] == 1


@pytest.mark.slow
def test_what_cannot_be_fails_in_its_lane():
    """Bounds and horizons that `validate` cannot see under a trace."""
    method = jg.Pseudospectral(nodes=4, segments=2, refinements=0)
    solve = jax.jit(lambda p: jg.solve(p, method, throw=False).result)
    of = lambda **changed: dataclasses.replace(DoubleIntegrator(), **changed)
    right = of(control_bounds=(-9.0, 9.0), final_time=1.0)
    upside_down = of(control_bounds=(9.0, -9.0), final_time=1.0)
    backwards = of(control_bounds=(-9.0, 9.0), final_time=-1.0)
    assert jg.RESULTS[solve(right)] == ""
    for wrong in (upside_down, backwards):
        assert solve(wrong) == jg.RESULTS.infeasible
    # Sequences of any kind are the same static field.
    kinds = ([1e-3, 1e-3], (1e-3, 1e-3), np.array([1e-3, 1e-3]))
    assert len({jg.Pseudospectral(relaxation=kind).relaxation for kind in kinds}) == 1


@pytest.mark.parametrize("start", [(0.0, 0.0), (jg.Free(-1.0, 0.25), 0.0)])
def test_a_start_outside_its_bounds_is_refused(start):
    problem = dataclasses.replace(
        DoubleIntegrator(), initial_state=start, state_bounds=((0.5, -9.0), (2.0, 9.0))
    )
    with pytest.raises(ValueError, match=r"x is .*outside state_bounds \[0.5, 2.0\]"):
        jg.solve(problem, jg.Pseudospectral())


def test_a_method_is_an_instance():
    method: Any = jg.Pseudospectral
    with pytest.raises(ValueError, match=r"give an instance, such as jg.Pseudospectral\(\)"):
        jg.solve(DoubleIntegrator(), method)


class Undefined(DoubleIntegrator):
    initial_state = (0.5, 0.0)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0] + 0.1 * jnp.log(0.7 - x[0])])


class Held(jg.Problem):
    """u would be 1.0005 but may not exceed 1; w would be 0 but for its integral of 1e-4."""

    state_names = ("x",)
    control_names = ("u", "w")
    initial_state = (0.0,)
    control_bounds = (-jnp.inf, jnp.array([1.0, jnp.inf]))
    integral_bounds = (1e-4, jnp.inf)

    def dynamics(self, t, x, u):
        return u[:1]

    def running_cost(self, t, x, u):
        return ((u[0] - 1.0005) ** 2 + u[1] ** 2) / 2

    def integrands(self, t, x, u):
        return u[1:]


class HeldByPath(Held):
    control_bounds = (-jnp.inf, jnp.inf)
    path_bounds = (-jnp.inf, 1.0)

    def path_constraints(self, t, x, u):
        return u[:1]


@pytest.mark.parametrize(("problem", "over"), [(Held(), 0.0), (HeldByPath(), 5e-6)])
@pytest.mark.slow
def test_controls_between_nodes_keep_to_what_holds_them(problem, over):
    e = jg.solve(problem, jg.Pseudospectral(nodes=4, segments=2, refinements=0))
    u = np.asarray(e(jnp.array([0.1, 0.5, 0.93])).u)
    # The barrier ends below 1e-9, over the bound's multiplier of 5e-4.
    np.testing.assert_allclose(u[:, 0], 1.0, atol=5e-6)
    assert np.all(u[:, 0] <= 1 + over)
    np.testing.assert_allclose(u[:, 1], 1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="integral constraints"):
        jg.linearize(e, jnp.array([0.1]))


@pytest.mark.slow
def test_failures_name_what_is_wrong():
    method = jg.Pseudospectral(nodes=4, segments=2)
    with pytest.raises(jg.SolveError, match=r"d\(v\)/dt is nan at node \d+ \(t = .*mend"):
        jg.solve(Undefined(), method)
    short = dataclasses.replace(DoubleIntegrator(), control_bounds=(-1.0, 1.0))
    with pytest.raises(jg.SolveError, match=r"Endpoint constraint 0 misses its bounds by 0\.\d+"):
        jg.solve(short, method)
    with pytest.raises(ValueError, match=r"need some .* GB of the"):
        jg.solve(DoubleIntegrator(), jg.Pseudospectral(nodes=500, segments=100_000))


@pytest.mark.slow
def test_discontinuous_dynamics_fail_the_certificate():
    class Torn(DoubleIntegrator):
        def dynamics(self, t, x, u):
            return jnp.stack([x[1], u[0] - jnp.where(x[0] > 0.437, 3.0, 0.0)])

    e = jg.solve(Torn(), jg.Pseudospectral(nodes=4, segments=2, refinements=0), throw=False)
    rows = {row["check"]: row["passed"] for row in e.certificate.rows()}
    assert not rows["state equation"]


@pytest.mark.slow
def test_warm_start_with_multipliers(capfd):
    """A solution of one mesh is one of the next, but for a few steps; the log counts them."""
    method = jg.Pseudospectral(nodes=5, segments=4, refinements=0, log=True)
    cold = jg.solve(problems.get("brachistochrone-wall"), method)
    jax.effects_barrier()
    first = capfd.readouterr().out.splitlines()
    moved = dataclasses.replace(method, fractions=np.array([0.0, 0.2, 0.45, 0.7, 1.0]))
    jg.solve(problems.get("brachistochrone-wall"), moved, guess=cold)
    jax.effects_barrier()
    second = capfd.readouterr().out.splitlines()
    assert first[0].startswith("designer units: ") and "time 1, " in first[0], first[0]
    assert first[1].split() == ["iter", "objective", "violation", "error", "mu", "delta", "step"]
    assert len(second) < len(first) / 2
