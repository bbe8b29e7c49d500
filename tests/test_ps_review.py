"""The reproduction of the 2012 review: its parts against closed forms and independent solvers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from jaxguide import reproduce
from jaxguide.nominal.direct.collocation import collocation
from jaxguide.reproduce.ps_review import (
    boundary,
    covectors,
    duality,
    gaussian,
    infinite,
    lq,
    published,
    qp,
    rates,
    uniform,
)
from jaxguide.spectral import nodes_lg, nodes_lgl, nodes_lgr, weighted_differentiation_matrix
from jaxguide.spectral.grids import differentiation

EPS = np.finfo(float).eps


@pytest.fixture(scope="module")
def report():
    return reproduce.get("ps-review").run()


def test_every_row_is_within_its_tolerance(report):
    assert [row.name for row in report.rows if not row.passed] == []
    assert sum(row.judged for row in report.rows) > 80
    assert report.figures == []


def test_deterministic(report):
    again = reproduce.get("ps-review").run()
    assert [row.computed for row in again.rows] == [row.computed for row in report.rows]


@pytest.mark.slow
def test_figures(tmp_path):
    report = reproduce.get("ps-review").run(tmp_path)
    assert len({p.name for p in tmp_path.glob("*.png")}) == len(report.figures) == 7


def test_uniform_weights_are_newton_cotes():
    """10 points, h = 2/9: Abramowitz & Stegun (1964), eq. 25.4.20."""
    known = np.array([2857, 15741, 1080, 19344, 5778]) * 9 / 89600 * 2 / 9
    w = uniform.solve_e1(10).w
    np.testing.assert_allclose(w, np.concatenate([known, known[::-1]]), atol=1e-14)


@pytest.mark.parametrize("points", [9, 10, 11, 12, 13])
def test_dual_interval_tells_whether_e1_is_bounded(points):
    found = uniform.solve_e1(points)
    assert found.unbounded is (points > 11) is (not found.bounded_by_dual)
    assert np.any(found.w < 0) == (points != published.POSITIVE_POINTS)
    if not found.unbounded:
        # Strictly inside: u = -1 is the only solution.
        v = uniform.capacity_weights(found.x)
        v *= found.w[-1] / v[-1]
        assert np.min(found.w - np.mean(found.gamma) * v) > 1e-4


@pytest.mark.parametrize("family", ["lgl", "lgr-left", "lg"])
def test_e2_agrees_with_another_optimiser(family):
    """SLSQP on the same program finds the same control where the ends are at nodes."""
    own = gaussian.solve_e2(family, 10)
    n, grid = 10, boundary.review_grid(family, 10)

    def defects(z):
        x1, x2, u = z.reshape(3, n)
        slopes = [grid.A @ x1 - x2 / 2, grid.A @ x2 - (u - x2) / 2]
        return np.concatenate([*slopes, [x1[0], x1[-1] - 1, x2[0] - 1, x2[-1] - 1]])

    found = minimize(
        lambda z: grid.w @ (z[n : 2 * n] * z[2 * n :]) / 2,
        np.concatenate([np.linspace(0, 1, n), np.ones(2 * n)]),
        constraints={"type": "eq", "fun": defects},
        bounds=[(None, None)] * n + [(0, None)] * n + [(0, 2)] * n,
        method="SLSQP",
        options={"maxiter": 300, "ftol": 1e-13},
    )
    # SLSQP with finite differences (1.5e-8) against a curvature of 4e-5: sqrt of the quotient.
    np.testing.assert_allclose(own.u, found.x[2 * n :], atol=2e-2)


def test_e2_curvature_is_negative_only_without_the_start():
    assert gaussian.solve_e2("lgr-left", 10).curvature > 0 > gaussian.solve_e2("lg", 10).curvature


def test_quadratic_program_against_a_projection():
    """With H = 1 and no equality the solution is the clipped centre."""
    centre = np.linspace(-2, 2, 7)
    one = np.ones(7)
    found = qp.solve_qp(np.eye(7), -centre, np.zeros((0, 7)), np.zeros(0), -one, one)
    np.testing.assert_allclose(found.z, np.clip(centre, -1, 1), atol=1e-15)
    np.testing.assert_allclose(found.bound, centre - found.z, atol=1e-15)
    assert found.violation < 1e-15


def test_a_failed_quadratic_program_says_so():
    both = np.array([[1.0, 1.0]])  # x + y = 3 within the unit box: nothing
    found = qp.solve_qp(np.eye(2), np.zeros(2), both, np.array([3.0]), -np.ones(2), np.ones(2))
    assert found.violation > 0.4


@pytest.mark.parametrize(
    ("weight", "nodes"), [("1", nodes_lgl), ("1-t", nodes_lgr), ("1-t^2", nodes_lg)]
)
def test_host_weighted_matrix_is_the_library_s(weight, nodes):
    functions = {"1": jnp.ones_like, "1-t": lambda t: 1 - t, "1-t^2": lambda t: 1 - t**2}
    x, _ = nodes(12)
    library = jax.jit(weighted_differentiation_matrix, static_argnums=1)(x, functions[weight])
    host = duality.weighted(x, differentiation(x), weight)
    # Rounding 1e-12 n^2 as for the plain matrix, times the greatest W_i/W_j.
    W = duality.WEIGHTS[weight][0](x)
    np.testing.assert_allclose(host, library, atol=1e-14 * 12**2 * W.max() / W.min())


@pytest.mark.parametrize("family", published.TABLE_1)
def test_integration_by_parts_holds_for_the_pair_of_table_1(family):
    pair = published.TABLE_1[family][0]
    assert duality.by_parts_defect(family, pair, 9) < 9**2 * EPS
    if pair != "1":
        assert duality.by_parts_defect(family, "1", 9) > 1  # negative control


def test_wrong_ends_converge_slowly():
    """Ends at nodes that are none: order 4, as (1 - t_N)^2 with 1 - t_N of order n^-2."""
    for family in ("lgr-left", "lg"):
        order = np.log2(
            boundary.error(family, "fixed-fixed", 16) / boundary.error(family, "fixed-fixed", 32)
        )
        assert 3.5 < order < 4.5


def test_manufactured_oscillator_is_an_extremal():
    """Its equations by central differences: error h^2 / 6 times a third derivative of 300."""
    p, t, h = covectors.oscillator(), np.linspace(-0.9, 0.9, 11), 1e-4
    rate = lambda f: (f(t + h) - f(t - h)) / (2 * h)
    x, costate, u, a = p.state(t), p.costate(t), p.control(t), p.a(t)
    limit = h**2 / 6 * 1e3
    np.testing.assert_allclose(
        rate(p.state), np.einsum("tij,tj->ti", a, x) + u[:, None] * p.b, atol=limit
    )
    force = x - p.target(t) + np.einsum("tji,tj->ti", a, costate)
    np.testing.assert_allclose(rate(p.costate), -force, atol=limit)
    np.testing.assert_allclose(u, -costate @ p.b, atol=1e-13)


def test_raw_lobatto_costate_is_off_by_the_null_mode():
    found = covectors.errors("lgl", 12)
    assert found.raw > 10 * found.closed
    # What was taken out is a multiple of P_N, a left null vector of D over w.
    x, w = nodes_lgl(12)
    last = np.polynomial.legendre.legval(x, np.eye(12)[-1])
    assert np.max(np.abs((w * last) @ collocation("lgl", 12).A)) < 12**2 * EPS


def test_gauss_commutes_at_every_size():
    for points in (4, 7, 12):
        assert covectors.errors("lg", points).gap < 1e-13


@pytest.mark.parametrize("weight", ["1-t", "1"])
def test_infinite_horizon(weight):
    # Geometric: five digits for ten points, from the reference's orders of magnitude.
    assert abs(infinite.regulator_cost(20, weight) - infinite.VALUE) < 1e-9
    assert abs(infinite.regulator_cost(40, weight) - infinite.VALUE) < 1e-13


def test_feasible_point_of_theorem_2_attains_its_residual():
    """delta^N = |v^T u| / |v|_1 against the same minimax residual as a linear program."""
    n = 23
    rule = boundary.review_grid("lgl", n)
    u = rates.path(rule.nodes, 2, 1)
    one = np.ones((n, 1))
    found = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.block([[rule.A, -one], [-rule.A, -one]]),
        b_ub=np.concatenate([u, -u]),
        bounds=(None, None),
    )
    # HiGHS allows 1e-7 of infeasibility.
    assert rates.feasible(n, 2)[0] == pytest.approx(found.fun, abs=1e-7)


def test_path_derivatives():
    t, h = np.array([-0.7, 0.1, 0.6]), 1e-5
    for m in (2, 3, 4, None):
        for order in (0, 1):
            slope = (rates.path(t + h, m, order) - rates.path(t - h, m, order)) / (2 * h)
            np.testing.assert_allclose(rates.path(t, m, order + 1), slope, atol=1e-8)


def test_saturated_solution():
    """The state is continuous in slope at the corner, meets its Riccati law after it, and J is the
    integral of its cost (trapezoids: error of order h^2)."""
    s, h = rates.Saturated, 1e-4
    t = np.arange(-1, 1 + h / 2, h)
    x, u = s.state(t), np.gradient(s.state(t), h)
    late = t[1:-1] > rates.KINK + h
    np.testing.assert_allclose(u[1:-1][late], -(np.tanh(1 - t) * x)[1:-1][late], atol=1e-7)
    assert np.trapezoid(x**2 + u**2, t) / 2 == pytest.approx(s.value(), abs=1e-6)
    assert np.max(-u) < 1 + 1e-8


def test_multipliers_satisfy_the_conditions_of_the_discrete_problem():
    p, rule = covectors.oscillator(), collocation("lgr-right", 9)
    ends = lq.end_rows(rule, extrapolated=True)
    system = lq.quadratic_program(rule, p, ends)
    found = lq.discretise(rule, p, ends)
    z = np.concatenate([found.x.reshape(-1), found.u])
    y = np.concatenate([found.defect.reshape(-1), found.end[0]])
    np.testing.assert_allclose(system.H @ z + system.cost + system.G.T @ y, 0, atol=1e-11)


def test_mapping_matrix_is_diagonal_for_the_right_dual_weight_only():
    w = boundary.review_grid("lg", 6).w
    P, rounding = duality.mapping_matrix("lg", "1-t^2", 6)
    np.testing.assert_allclose(P, -np.diag(1 / w), atol=rounding)
    P, _ = duality.mapping_matrix("lg", "1-t", 6)
    assert np.max(np.abs(P - np.diag(np.diag(P)))) > 1
