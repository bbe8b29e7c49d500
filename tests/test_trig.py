import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxguide.trig import X_MAX, cos, sin, sincos

DTYPES = [np.float64, np.float32]
# The docstring's absolute errors; measured maxima are 1.7e-16 and 9e-8.
ATOL = {np.float64: 2e-16, np.float32: 1e-7}
# Near the zeros, relative. Measured: 3e-16 and 6e-6 (float32 has 46 bits of pi/2).
RTOL = {np.float64: 5e-16, np.float32: 2e-5}


def reference(x):
    """Sine and cosine of the very floats in `x`, to longdouble."""
    exact = lambda f, v: np.longdouble(mp.nstr(f(mp.mpf(v)), 25))
    with mp.workprec(200):
        return np.array([[exact(f, v) for v in x.astype(float).tolist()] for f in (mp.sin, mp.cos)])


def arguments(dtype, scale, n=300):
    """Random angles up to `scale`, and the floats at and beside multiples of pi/4."""
    rng = np.random.default_rng(0)
    m = int(scale * 4 / np.pi)
    special = (rng.integers(-m, m + 1, n) * (np.pi / 4)).astype(dtype)
    beside = np.nextafter(special, dtype(np.inf))
    x = np.concatenate([rng.uniform(-scale, scale, n).astype(dtype), special, beside])
    return x[np.abs(x) <= X_MAX]


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["eager", "jit"])
@pytest.mark.parametrize("scale", [1, 30, 1e3, X_MAX])
@pytest.mark.parametrize("dtype", DTYPES)
def test_against_mpmath(dtype, scale, transform):
    x = arguments(dtype, scale)
    for got, want in zip(transform(sincos)(jnp.asarray(x)), reference(x), strict=True):
        assert got.dtype == dtype
        error = np.abs(np.asarray(got, np.longdouble) - want)
        assert error.max() < ATOL[dtype]
        tiny = np.finfo(dtype).tiny  # XLA flushes subnormals to zero
        assert np.all(error <= RTOL[dtype] * np.abs(want) + tiny)


@pytest.mark.parametrize("dtype", DTYPES)
def test_quadrants_and_zero(dtype):
    s, c = sincos(jnp.asarray(np.array([0, 1, 2, 3, -1, -2, -3]) * np.pi / 2, dtype))
    # The float nearest k pi/2 is off by its rounding, here up to 3 pi/2 * eps / 2.
    atol = 3 * np.finfo(dtype).eps
    np.testing.assert_allclose(s, [0, 1, 0, -1, -1, 0, 1], atol=atol)
    np.testing.assert_allclose(c, [1, 0, -1, 0, 0, -1, 0], atol=atol)
    assert s[0] == 0 and c[0] == 1


@pytest.mark.parametrize("dtype", DTYPES)
def test_identities(dtype):
    x = jnp.asarray(arguments(dtype, 1e3))
    s, c = sincos(x)
    eps = np.finfo(dtype).eps  # each square, and the sum, rounds by at most eps
    np.testing.assert_allclose(s * s + c * c, 1, rtol=4 * eps)
    minus_s, same_c = sincos(-x)
    np.testing.assert_array_equal(minus_s, -s)
    np.testing.assert_array_equal(same_c, c)
    np.testing.assert_array_equal(sin(x), s)
    np.testing.assert_array_equal(cos(x), c)


@pytest.mark.parametrize("dtype", DTYPES)
def test_nan_where_it_cannot_answer(dtype):
    limit = dtype(X_MAX)
    beyond = np.nextafter(limit, dtype(np.inf))
    largest = np.finfo(dtype).max
    bad = np.array([np.nan, np.inf, -np.inf, beyond, -beyond, 1e20, largest], dtype)
    for f in (sincos, jax.jit(sincos)):
        assert all(jnp.isnan(y).all() for y in f(jnp.asarray(bad)))
        assert all(jnp.isfinite(y).all() for y in f(jnp.asarray([limit, -limit])))


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 1, 3)])
def test_shapes(shape):
    assert [y.shape for y in sincos(jnp.ones(shape))] == [shape, shape]


@pytest.mark.parametrize("x", [1, np.arange(3), True, np.float16(1), 1j])
def test_rejects_other_dtypes(x):
    with pytest.raises(TypeError, match="float32 or float64, got"):
        sincos(jnp.asarray(x))


def test_python_float_is_accepted():
    np.testing.assert_allclose(sincos(0.5), (np.sin(0.5), np.cos(0.5)), rtol=1e-15)


def test_gradients():
    x = jnp.asarray([-40.0, -1.5, 0.0, 0.3, np.pi / 4, 2.0, 1e3])
    check_grads(jax.jit(sincos), (x,), order=2, modes=["fwd", "rev"])


@pytest.mark.parametrize("d", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_the_values_themselves(d):
    orders = jax.jit(jax.vmap(lambda x: (sincos(x), d(sincos)(x), d(d(d(sincos)))(x))))
    (s, c), one, three = orders(jnp.asarray([-3.0, 0.2, 2.5, 70.0]))
    # jit may contract a multiply and an add differently around each use
    np.testing.assert_allclose(one, (c, -s), atol=2 * ATOL[np.float64])
    np.testing.assert_allclose(three, (-c, s), atol=2 * ATOL[np.float64])


def test_float32_gradient_keeps_dtype():
    assert jax.grad(sin)(jnp.float32(1)).dtype == jnp.float32


def test_no_library_call_gather_or_branch():
    text = jax.jit(sincos).lower(jnp.ones(64)).as_text()
    for op in ("sine", "cosine", "gather", "case", "while"):
        assert f"stablehlo.{op} " not in text and f'"stablehlo.{op}"' not in text
