"""Interpolation: exact at nodes, derivatives everywhere, rates of convergence."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxguide.spectral import (
    barycentric_weights,
    interpolate,
    interpolate_piecewise,
    interpolation_matrix,
    nodes_cgl,
    nodes_lg,
    nodes_lgl,
    nodes_lgr,
)

EPS = np.finfo(float).eps
FINE = np.linspace(-1, 1, 2001)


def lagrange(x, f, q):
    """Products, review eq. (8): slow and free of removable singularities."""
    eye = jnp.eye(x.size)
    factors = (q - x[None, :]) / (x[:, None] - x[None, :] + eye)
    return jnp.prod(jnp.where(eye == 1, 1.0, factors), axis=1) @ f


def derivatives(g):
    """Value, forward and reverse Jacobians and forward over reverse, in nodes, values, query."""
    return jax.jit(
        lambda *a: (
            g(*a),
            jax.jacfwd(g, (0, 1, 2))(*a),
            jax.jacrev(g, (0, 1, 2))(*a),
            jax.jacfwd(jax.jacrev(lambda *b: g(*b)[0], (0, 2)), (0, 2))(*a),
        )
    )


def test_value_and_two_derivatives_in_everything():
    x = jnp.asarray(nodes_lgl(6)[0])
    f = jnp.stack([jnp.sin(2 * x), jnp.exp(x)], axis=1)
    ours, theirs = derivatives(interpolate), derivatives(lagrange)
    for q in (0.3, x[2], 1.0, -1.0, 1.1):  # beside a node, at one, at the ends, beyond
        # Second derivatives are of size n^4 / 4 = 300; rounding n^2 eps of that is 2e-12.
        jax.tree.map(
            lambda u, v: np.testing.assert_allclose(u, v, atol=1e-11),
            ours(x, f, jnp.asarray(q)),
            theirs(x, f, jnp.asarray(q)),
        )


def test_check_grads():
    x = jnp.asarray(nodes_lg(5)[0])
    f = jnp.stack([jnp.sin(2 * x), x**2], axis=1)
    for q in (x[1], jnp.asarray(0.1)):
        # Step 1e-5: truncation of order (1e-5 / spacing 0.3)^2 n^3 = 1e-7.
        check_grads(
            jax.jit(interpolate), (x, f, q), 1, ["fwd", "rev"], atol=1e-6, rtol=1e-6, eps=1e-5
        )


@pytest.mark.parametrize("n", [17, 512])
def test_exact_at_nodes_and_beside_them(n):
    for x, _ in (nodes_lg(n), nodes_lgr(n)):
        f = np.random.default_rng(n).normal(size=(n, 2))
        np.testing.assert_array_equal(jax.jit(interpolate)(x, f, x), f)
        np.testing.assert_array_equal(jax.jit(interpolation_matrix)(x, x), np.eye(n))
    # Beside a node at 0 the quotient w / dx of the textbook formula overflows.
    x, _ = nodes_lg(17)
    np.testing.assert_allclose(jax.jit(interpolate)(x, x + 1, 1e-310), 1.0, atol=17 * EPS)


def test_rows_reproduce_polynomials_and_ends():
    x, _ = nodes_lg(16)
    at = np.array([-1.0, 0.123, 1.0])
    m = np.asarray(jax.jit(interpolation_matrix)(x, at, jax.jit(barycentric_weights)(x)))
    # Lebesgue constant of LG at the ends, sqrt(n) times a small number, times n eps.
    np.testing.assert_allclose(m @ x**15, np.array([-1, 0.123**15, 1]), atol=4 * 16**1.5 * EPS)
    np.testing.assert_allclose(m.sum(axis=1), 1, atol=16 * EPS)


def rate_of_convergence(f, rule, sizes, scale):
    at = jax.jit(interpolate)
    error = [np.abs(np.asarray(at(x, f(x), FINE)) - f(FINE)).max() for x, _ in map(rule, sizes)]
    return np.polyfit(scale(sizes), np.log(error), 1)[0]


@pytest.mark.parametrize("rule", [nodes_lgl, nodes_cgl])
def test_runge_converges_at_its_bernstein_rate(rule):
    rho = (1 + np.sqrt(26)) / 5  # the pole i/5 lies on this ellipse
    rate = rate_of_convergence(lambda x: 1 / (1 + 25 * x**2), rule, [21, 61, 101], np.asarray)
    # Measured 5e-5 and 2e-4: a factor n^(1/2) in the constant alone would show as 0.01.
    assert abs(rate + np.log(rho)) < 1e-3


@pytest.mark.parametrize("rule", [nodes_lgl, nodes_cgl])
def test_limited_smoothness_converges_algebraically(rule):
    # |x|^3 has a third derivative of bounded variation: n^-3 (Trefethen, ATAP, theorem 7.2).
    rate = rate_of_convergence(lambda x: np.abs(x) ** 3, rule, [16, 64, 256], np.log)
    # Degree n - 1 against n steepens the start of the line by 1/16.
    assert abs(rate + 3) < 0.1


# Two segments of unit and double length, with empty ones before, between and after.
BREAKS = jnp.array([0.0, 0.0, 1.0, 1.0, 3.0, 3.0])
NODES = nodes_lg(4)[0]


def cubics(breaks, jump=0.0):
    """t^3 and t^2 - 1 on the breaks; from t = 1 on, `jump` is added."""
    t = (
        breaks[:-1, None]
        + (breaks[1:] - breaks[:-1])[:, None] * (jnp.asarray(NODES)[None, :] + 1) / 2
    )
    step = jnp.where(breaks[:-1] >= 1, jump, 0.0)[:, None, None]
    return jnp.stack([t**3, t**2 - 1], axis=-1) + step


def test_piecewise_values_and_derivatives():
    values = jax.jit(cubics)(BREAKS, 5.0)
    at = jax.jit(lambda t: interpolate_piecewise(BREAKS, values, t, NODES))
    t = jnp.array([0.0, 0.3, 0.999, 1.0, 1.7, 3.0])
    after = jnp.where(t >= 1, 5.0, 0.0)
    # Rounding of values up to 32 by a Lebesgue constant of 4.
    np.testing.assert_allclose(
        jax.jit(jax.vmap(at))(t), jnp.stack([t**3 + after, t**2 - 1 + after], 1), atol=128 * EPS
    )
    slope = jax.jit(jax.vmap(jax.jacfwd(at)))(t)
    np.testing.assert_allclose(slope, jnp.stack([3 * t**2, 2 * t], 1), atol=16 * 128 * EPS)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacrev(at)))(t), slope, atol=16 * 128 * EPS)
    for outside, edge in ((-2.0, 0.0), (7.0, 3.0)):
        np.testing.assert_array_equal(at(jnp.asarray(outside)), at(jnp.asarray(edge)))
        assert bool(jnp.all(jax.jit(jax.jacfwd(at))(jnp.asarray(outside)) == 0))


def test_piecewise_gradients():
    breaks = jnp.array([0.0, 0.5, 2.0])
    f = jax.jit(lambda b, v, t: interpolate_piecewise(b, v, t, NODES))
    for t in (0.2, 1.1):
        args = (breaks, cubics(breaks), jnp.asarray(t))
        # Step 1e-5 on cubics over lengths of 0.5: truncation 1e-9.
        check_grads(f, args, 1, ["fwd", "rev"], atol=1e-6, rtol=1e-6, eps=1e-5)
    # Values that move with the breaks give the same cubic: no derivative is left.
    moving = jax.jit(jax.jacfwd(lambda b: f(b, cubics(b), 0.7)))(BREAKS)
    np.testing.assert_allclose(moving, 0, atol=64 * EPS)
    empty = jnp.zeros(3)  # all segments empty: some value, no NaN
    whole = jax.jit(jax.grad(lambda b: f(b, jnp.ones((2, 4)), 0.0)))(empty)
    assert bool(jnp.all(jnp.isfinite(whole)))


def test_batches_compile_once_without_lapack():
    f = eqx.debug.assert_max_traces(interpolate_piecewise, max_traces=1)
    slope = jax.grad(lambda t, b: f(b, jnp.broadcast_to(b[:-1, None], (2, 4)), t, NODES))
    many = jax.jit(jax.vmap(slope))
    t, b = jnp.linspace(0.1, 1.9, 8), jnp.linspace(0, 2, 3)[None, :] * jnp.ones((8, 1))
    assert many(t, b).shape == many(t + 0.01, b).shape == (8,)
    x = jnp.asarray(nodes_lgl(6)[0])[None, :] * jnp.ones((8, 1))
    on_nodes = jax.jit(jax.vmap(jax.grad(lambda x, q: interpolate(x, x**2, q))))
    assert bool(jnp.all(jnp.isfinite(on_nodes(x, x[:, 2]))))
    for program in (many.lower(t, b), on_nodes.lower(x, t)):
        assert "lapack" not in program.as_text().lower()


def test_follows_dtype():
    x, f = nodes_lgl(8)[0], jnp.ones((8, 2), jnp.float32)
    assert jax.eval_shape(lambda: interpolate(x, f, 0.3)).dtype == jnp.float32
    for b in (np.array([0.0, 1.0]), jnp.array([0.0, 1.0], jnp.float32)):
        g = lambda b=b: interpolate_piecewise(b, f[None], 0.3, x)
        assert jax.eval_shape(g).dtype == jnp.float32


def test_bad_shapes():
    # TypeError: under --jaxtyping-packages the annotations speak before the function does.
    bad = (ValueError, TypeError)
    with pytest.raises(bad):
        interpolate(np.arange(3.0), np.zeros(4), 0.0)
    with pytest.raises(ValueError, match="distinct"):
        interpolate(np.array([0.0, 0.0]), np.zeros(2), 0.0)
    with pytest.raises(bad):
        interpolate_piecewise(np.arange(3.0), np.zeros((3, 4)), 0.0, NODES)
