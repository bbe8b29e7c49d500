"""Coefficient transforms and domain maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import special

from jaxguide.spectral import (
    BilinearMap,
    LinearMap,
    chebyshev_coefficients,
    chebyshev_matrix,
    chebyshev_values,
    chebyshev_vandermonde,
    grid,
    legendre_coefficients,
    legendre_matrix,
    legendre_values,
    legendre_vandermonde,
    nodes_lg,
    nodes_lgl,
)

EPS = np.finfo(float).eps
SERIES = {
    "legendre": (legendre_coefficients, legendre_values),
    "chebyshev": (chebyshev_coefficients, chebyshev_values),
}


@pytest.mark.parametrize("series", SERIES)
@pytest.mark.parametrize("family", ["lg", "lgl", "cgl", "lgr-left"])
@pytest.mark.parametrize("n", [1, 9, 128])
def test_round_trip(series, family, n):
    if n == 1 and family in ("lgl", "cgl"):
        return
    forward, back = map(jax.jit, SERIES[series])
    x = grid(family, n).x
    c = np.random.default_rng(n).normal(size=(n, 2))
    # Bases bounded by 1; recurrences lose n eps, Legendre's projection scales by n.
    tol = n * (n + 3) * EPS * np.abs(c).max()
    np.testing.assert_allclose(forward(x, back(x, c)), c, atol=tol)
    np.testing.assert_allclose(back(x, forward(x, c)), c, atol=tol)


def test_known_coefficients():
    for family in ("lg", "lgl", "cgl"):
        x = grid(family, 24).x
        k = np.arange(24)
        # e^x: Chebyshev 2 I_k(1), Legendre (2k + 1) i_k(1); aliasing is below I_24(1) = 1e-31.
        bessel = np.where(k == 0, 1, 2) * special.iv(k, 1)
        np.testing.assert_allclose(
            jax.jit(chebyshev_coefficients)(x, np.exp(x)), bessel, atol=48 * EPS
        )
        spherical = (2 * k + 1) * special.spherical_in(k, 1.0)
        np.testing.assert_allclose(
            jax.jit(legendre_coefficients)(x, np.exp(x)), spherical, atol=96 * EPS
        )
    # x^3 = (3 P_1 + 2 P_3) / 5 = (3 T_1 + T_3) / 4, on uneven nodes too.
    x = np.array([-0.9, -0.2, 0.4, 0.7])
    np.testing.assert_allclose(
        jax.jit(legendre_coefficients)(x, x**3), [0, 0.6, 0, 0.4], atol=64 * EPS
    )
    np.testing.assert_allclose(
        jax.jit(chebyshev_coefficients)(x, x**3), [0, 0.75, 0, 0.25], atol=64 * EPS
    )


def legendre_of_ramp(x):
    return legendre_values(x, np.arange(5.0))


def test_vandermonde_matrices_and_gradients():
    x = np.array([-1.0, -0.3, 0.5, 1.0])
    n = np.arange(40)
    # Recurrences: n eps in the interior.
    np.testing.assert_allclose(
        legendre_vandermonde(x, 40), special.eval_legendre(n[None], x[:, None]), atol=80 * EPS
    )
    np.testing.assert_allclose(
        chebyshev_vandermonde(x, 40), np.cos(n[None] * np.arccos(x[:, None])), atol=160 * EPS
    )
    for v in (legendre_vandermonde, chebyshev_vandermonde):
        with pytest.raises(ValueError, match="n >= 1"):
            v(x, 0)
    x = jnp.asarray(nodes_lg(5)[0])
    for f in (legendre_matrix, chebyshev_matrix, legendre_of_ramp):
        # Step 1e-5 at a spacing of 0.3: truncation 1e-9 times the size of third derivatives.
        check_grads(jax.jit(f), (x,), order=1, modes=["fwd", "rev"], eps=1e-5, atol=1e-7, rtol=1e-7)
        assert jax.eval_shape(f, x.astype(jnp.float32)).dtype == jnp.float32
    batch = jax.jit(jax.vmap(legendre_coefficients))(jnp.stack([x, -x]), jnp.stack([x, x]))
    np.testing.assert_allclose(batch[1], [0, -1, 0, 0, 0], atol=40 * EPS)


def test_linear_map():
    g = LinearMap(2.0, 7.0)
    tau = jnp.asarray(nodes_lgl(9)[0])
    assert g(tau)[0] == 2 and g(tau)[-1] == 7 and float(g.inverse(7.0)) == 1
    np.testing.assert_allclose(
        g.inverse(g(tau)), tau, atol=8 * EPS
    )  # times (|t0| + |tf|)/(tf - t0)
    np.testing.assert_array_equal(g.derivative(tau), jax.jit(jax.vmap(jax.grad(g)))(tau))
    # A free final time: dt/dtf = (1 + tau)/2.
    moved = jax.jacfwd(lambda tf: LinearMap(2.0, tf)(tau))(jnp.asarray(7.0))
    np.testing.assert_allclose(moved, (1 + tau) / 2, atol=EPS)


def test_bilinear_map():
    g = BilinearMap()
    tau = jnp.asarray(nodes_lg(9)[0])
    np.testing.assert_allclose(g(tau), (1 + tau) / (1 - tau), rtol=2 * EPS)  # review, eq. (6)
    g = BilinearMap(t0=3.0, scale=2.0)
    assert float(g(-1.0)) == 3 and float(g(0.0)) == 5
    np.testing.assert_allclose(g.inverse(g(tau)), tau, atol=8 * EPS)
    # Sensitive by t/s: (1 - tau)^-2 ulps relative.
    np.testing.assert_allclose(g.derivative(tau), jax.jit(jax.vmap(jax.grad(g)))(tau), rtol=8 * EPS)
    assert float(g.inverse(jnp.inf)) == 1 and float(jax.grad(g.inverse)(jnp.inf)) == 0
    check_grads(
        jax.jit(lambda t0, s, x: BilinearMap(t0, s)(x)),
        (3.0, 2.0, tau),
        order=1,
        eps=1e-5,
        atol=1e-5,
        rtol=1e-5,
    )  # fmt: skip  (pole at 1 - tau = 0.03: third derivatives 1e6)


@pytest.mark.parametrize("make", [LinearMap, BilinearMap])
def test_maps_follow_dtype_and_batch(make):
    g = make(jnp.float32(0.0), jnp.float32(2.0))
    for f in (g, g.derivative, g.inverse):
        assert f(nodes_lg(4)[0]).dtype == jnp.float32
    t = jax.jit(jax.vmap(lambda tf: make(0.0, tf)(jnp.zeros(3))))(jnp.array([1.0, 2.0]))
    assert t.shape == (2, 3)
