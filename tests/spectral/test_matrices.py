"""Differentiation, integration, Birkhoff and weighted matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from numpy.polynomial import legendre

from jaxguide.spectral import (
    barycentric_weights,
    birkhoff_matrix,
    differentiation_matrix,
    grid,
    integration_matrix,
    nodes_lg,
    nodes_lgl,
    nodes_lgr,
    weighted_differentiation_matrix,
    weighted_quadrature,
)

# Compiled whole: op by op, every new size would compile each operation anew.
DIFFERENTIATION, INTEGRATION = jax.jit(differentiation_matrix), jax.jit(integration_matrix)
BIRKHOFF = jax.jit(birkhoff_matrix, static_argnums=1)

EPS = np.finfo(float).eps
FAMILIES = ["lg", "lgl", "cgl", "lgr-left", "lgr-right"]


def legendre_pair(n, x, calculus):
    """Values at `x` of Legendre series of degree n - 1, and of their derivatives or integrals."""
    c = np.random.default_rng(n).normal(size=(n, 3)) / np.sqrt(n)
    return legendre.legval(x, c).T, legendre.legval(x, calculus(c)).T


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("n", [2, 8, 33])
def test_differentiation_exact_below_degree_n(family, n):
    x = grid(family, n).x
    f, df = legendre_pair(n, x, legendre.legder)
    d = np.asarray(DIFFERENTIATION(x))
    # Values with relative errors n eps (their recurrence), times |D|, of row sums O(n^2).
    bound = 4 * n * EPS * np.abs(d).sum(axis=1).max() * np.abs(f).max()
    assert np.abs(d @ f - df).max() < bound < 1e-8


def test_differentiation_at_512_points():
    for family in FAMILIES:
        x = grid(family, 512).x
        d = np.asarray(DIFFERENTIATION(x))
        # Exact values here are rounded once: n^2 eps = 6e-11, times a small constant.
        np.testing.assert_allclose(d @ np.sin(5 * x), 5 * np.cos(5 * x), atol=10 * 512**2 * EPS)
    w = np.asarray(jax.jit(barycentric_weights)(np.linspace(-1, 1, 512)))
    binomial = -np.diff(np.log(np.abs(w)))[:5]  # w_j = +-C(511, j) up to a factor
    np.testing.assert_allclose(
        -binomial, np.log((511 - np.arange(5)) / np.arange(1, 6)), rtol=1e-10
    )


def test_weights_are_those_of_the_definition():
    x = np.array([-1.0, -0.25, 0.5, 0.75])
    w = np.asarray(barycentric_weights(x))
    g = 4 / 1.75
    np.testing.assert_allclose(
        w, [1 / np.prod([g * (a - b) for b in x if b != a]) for a in x], rtol=8 * EPS
    )


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("n", [2, 8, 33, 512])
def test_integration_exact_below_degree_n(family, n):
    x = grid(family, n).x
    f, _ = legendre_pair(n, x, legendre.legint)
    for start in (-1.0, 0.3):
        integral = legendre_pair(n, x, lambda c, s=start: legendre.legint(c, lbnd=s))[1]
        got = np.asarray(INTEGRATION(x, start)) @ f
        # Row sums of |B| <= 2 x Lebesgue constant; LG and LGR have constants O(sqrt n) at the end.
        np.testing.assert_allclose(got, integral, atol=2 * n**1.5 * EPS * np.abs(f).max())


def test_integration_to_the_far_end_is_the_quadrature():
    for rule in (nodes_lgl, lambda n: nodes_lgr(n, "right")):
        x, w = rule(12)
        np.testing.assert_allclose(INTEGRATION(x)[-1], w, atol=12 * EPS)


def test_one_node():
    assert differentiation_matrix(np.zeros(1)) == 0 and integration_matrix(np.zeros(1)) == 1
    assert barycentric_weights(np.zeros(1)) == 1


def test_birkhoff():
    for end, e in (("left", -1.0), ("right", 1.0)):
        for n in (1, 9, 64):
            x, _ = nodes_lg(n)
            c = np.random.default_rng(n).normal(size=n + 1) / np.sqrt(n + 1)  # degree n
            y, dy = legendre.legval(x, c), legendre.legval(x, legendre.legder(c))
            m = np.asarray(BIRKHOFF(x, end))
            given = np.concatenate([[legendre.legval(e, c)], dy])
            # |B| <= 2 and slopes up to n^2, each with relative error n eps.
            np.testing.assert_allclose(m @ given, y, atol=4 * n * EPS * np.abs(given).max())
    with pytest.raises(ValueError, match="end must be"):
        birkhoff_matrix(x, "top")


@pytest.mark.parametrize(
    ("x", "weight", "extra"),
    [
        (nodes_lgr(9)[0], lambda t: 1 - t, [1.0]),
        (nodes_lg(9)[0], lambda t: 1 - t**2, [-1.0, 1.0]),
    ],
)
def test_weighted_is_lagrange_on_the_grid_with_the_zeros_of_w(x, weight, extra):
    # (1 - t) phi_j(t) / (1 - t_j) is the Lagrange polynomial of the nodes and +1.
    n = x.size
    full = np.asarray(DIFFERENTIATION(np.concatenate([x, extra])))[:n, :n]
    got = np.asarray(jax.jit(lambda x: weighted_differentiation_matrix(x, weight))(x))
    np.testing.assert_allclose(got, full, rtol=1e-12, atol=n**2 * EPS * np.abs(full).max())
    quadrature = np.asarray(jax.jit(lambda x: weighted_quadrature(x, weight))(x))
    c = np.random.default_rng(0).normal(size=n)
    y = legendre.Legendre(c) * (1 - legendre.Legendre([0, 1])) * (1 + legendre.Legendre([0, 1]))
    if extra == [1.0]:
        y = legendre.Legendre(c) * (1 - legendre.Legendre([0, 1]))
    exact = y.integ()(1.0) - y.integ()(-1.0)
    np.testing.assert_allclose(quadrature @ y(x), exact, atol=4 * n * EPS * np.abs(c).sum())
    # Eq. (11) on W times the polynomial.
    np.testing.assert_allclose(got @ y(x), y.deriv()(x), atol=4 * n**2 * EPS * np.abs(c).sum())


def test_unit_weight_is_unweighted():
    x, w = nodes_lgl(9)
    one = lambda t: jnp.ones_like(t)
    got = jax.jit(lambda x: weighted_differentiation_matrix(x, one))(x)
    np.testing.assert_allclose(got, DIFFERENTIATION(x), rtol=4 * EPS)
    quadrature = jax.jit(lambda x: weighted_quadrature(x, one))(x)
    np.testing.assert_allclose(quadrature, w, atol=9 * EPS)


def test_infinite_horizon_converges():
    # e^{-t} under t = (1 + tau)/(1 - tau), review eq. (6): smooth, essential singularity at +1.
    matrix = jax.jit(lambda x: weighted_differentiation_matrix(x, lambda s: 1 - s))
    error = []
    for n in (20, 40, 80):
        x, _ = nodes_lgr(n)
        y, dy = np.exp(-(1 + x) / (1 - x)), -2 / (1 - x) ** 2 * np.exp(-(1 + x) / (1 - x))
        got = np.asarray(matrix(x)) @ y
        error.append(np.abs(got - dy).max())
    # Faster than any power: measured 4.3e-4, 1.8e-6, 1.3e-10; each step gains more than the last.
    assert error[2] < 1e-9 and error[1] / error[2] > 10 * error[0] / error[1] > 1000, error


def test_host_grids_equal_the_jax_matrices():
    for family in FAMILIES:
        for n in (2, 33):
            g = grid(family, n)
            d, b = DIFFERENTIATION(g.x), INTEGRATION(g.x)
            scale = np.abs(g.differentiation).max()
            np.testing.assert_allclose(g.differentiation, d, atol=2 * n * EPS * scale)
            np.testing.assert_allclose(g.integration, b, atol=4 * n * EPS)
            c = np.random.default_rng(n).normal(size=n)
            ends = g.ends @ legendre.legval(g.x, c)
            # Beyond the last node the Lebesgue constant is O(sqrt n), of LG.
            np.testing.assert_allclose(
                ends, legendre.legval([-1.0, 1.0], c), atol=n**1.5 * EPS * np.abs(c).sum()
            )
            assert not g.integration.flags.writeable
    with pytest.raises(ValueError, match="'gauss'"):
        grid("gauss", 4)


def test_gradients_with_respect_to_nodes():
    x = jnp.asarray(nodes_lg(5)[0])
    # Step 1e-5: relative truncation up to (1e-5 / 0.05)^2 = 4e-8, 0.05 being the distance from
    # the last node to the zero of W, against the greatest entry, some 10; sums of 25 of them.
    close = dict(order=1, modes=["fwd", "rev"], eps=1e-5, atol=1e-5, rtol=1e-6)
    minus = lambda t: 1 - t
    both = lambda x, start: (
        differentiation_matrix(x),
        integration_matrix(x, start),
        weighted_differentiation_matrix(x, minus),
        weighted_quadrature(x, minus),
    )
    check_grads(jax.jit(both), (x, jnp.asarray(0.2)), **close)
    check_grads(jax.jit(barycentric_weights), (x,), **close)


def test_jit_vmap_and_float32():
    x = jnp.stack([jnp.asarray(nodes_lg(6)[0]), jnp.asarray(nodes_lgl(6)[0])])
    for f in (differentiation_matrix, integration_matrix, birkhoff_matrix):
        batched, f = jax.jit(jax.vmap(f))(x), jax.jit(f)
        np.testing.assert_allclose(batched[1], f(x[1]), atol=1e-13)  # 6^2 eps times 10
        single = f(x[0].astype(jnp.float32))
        assert single.dtype == jnp.float32
        # n^2 eps of float32 = 4e-6, and the same again for the rounded nodes.
        np.testing.assert_allclose(single, f(x[0]), atol=2e-5)
    for family in FAMILIES:  # no overflow at n = 512 in float32
        d = DIFFERENTIATION(jnp.asarray(grid(family, 512).x, jnp.float32))
        assert bool(jnp.all(jnp.isfinite(d)))


def test_bad_input():
    for f in (differentiation_matrix, integration_matrix, barycentric_weights):
        with pytest.raises(ValueError, match="distinct"):
            f(np.array([0.0, 0.5, 0.5]))
    with pytest.raises(ValueError, match="nodes_lgr"):
        weighted_differentiation_matrix(nodes_lgl(4)[0], lambda t: 1 - t)
