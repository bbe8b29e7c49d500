"""Small dense algebra without LAPACK, against LAPACK and by identities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxguide.linalg import cholesky_positive, gauss_solve, left_null_space

EPS = np.finfo(float).eps


def matrix(n, seed=0):
    return np.random.default_rng(seed).normal(size=(n, n))


# 8 and 9 sit on either side of the switch from unrolled to looped elimination.
@pytest.mark.parametrize("n", [1, 2, 6, 8, 9, 30])
def test_solve_is_backward_stable(n):
    a, b = matrix(n), np.random.default_rng(1).normal(size=(n, 3))
    x = np.asarray(gauss_solve(jnp.asarray(a), jnp.asarray(b)))
    # Gauss-Jordan with partial pivoting: the residual is a few n eps |A| |x| (Higham, 2002,
    # section 14.4); growth of the pivots is below n for random matrices.
    assert np.abs(a @ x - b).max() <= 10 * n * n * EPS * np.abs(a).max() * np.abs(x).max()
    one = np.asarray(gauss_solve(jnp.asarray(a), jnp.asarray(b[:, 0])))
    assert one.shape == (n,)
    np.testing.assert_allclose(one, x[:, 0], rtol=1e-10)


def test_solve_pivots():
    # Zero leading entry; and a pivot of 1e-20, which without a row exchange loses everything.
    np.testing.assert_array_equal(
        gauss_solve(jnp.array([[0.0, 1], [2, 0]]), jnp.array([3.0, 4])), [2, 3]
    )
    got = gauss_solve(jnp.array([[1e-20, 1.0], [1.0, 1.0]]), jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(got, [1, 1], rtol=4 * EPS)


def test_solve_in_wide_scales():
    # Rows and columns of very different size, as state and costate have.
    d = np.array([1e-8, 1e3, 1.0, 1e6])
    a, b = matrix(4) * d[:, None], matrix(4, 1)[:, 0]
    np.testing.assert_allclose(
        gauss_solve(jnp.asarray(a), jnp.asarray(b)), np.linalg.solve(a, b), rtol=1e-12
    )


def test_singular_matrix_gives_no_finite_answer():
    got = gauss_solve(jnp.array([[1.0, 2.0], [2.0, 4.0]]), jnp.array([1.0, 1.0]))
    assert not np.all(np.isfinite(got))


@pytest.mark.parametrize("n", [3, 10])
def test_solve_derivatives(n):
    a, b = jnp.asarray(matrix(n)), jnp.asarray(matrix(n, 1)[:, :2])
    check_grads(jax.jit(gauss_solve), (a, b), order=2, modes=["fwd", "rev"])


def test_solve_batches():
    # A batch of 64 is where vmapped LAPACK calls have hung.
    a = jnp.asarray(np.random.default_rng(2).normal(size=(64, 5, 5)))
    b = jnp.asarray(np.random.default_rng(3).normal(size=(64, 5)))
    got = jax.jit(jax.vmap(gauss_solve))(a, b)
    want = np.stack([np.linalg.solve(p, q) for p, q in zip(a, b, strict=True)])
    # The worst of 64 random matrices has a condition number of some 1e3.
    np.testing.assert_allclose(got, want, rtol=1e-10, atol=1e-10)


def test_solve_uses_no_lapack():
    text = jax.jit(jax.vmap(gauss_solve)).lower(jnp.ones((4, 3, 3)), jnp.ones((4, 3))).as_text()
    assert "lapack" not in text


@pytest.mark.parametrize(
    ("eigenvalues", "positive"),
    [
        ((1.0, 2.0, 3.0), True),
        ((1e-9, 1.0, 5.0), True),
        ((-1e-9, 1.0, 5.0), False),
        ((-1.0, -2.0, 3.0), False),
    ],
)
def test_cholesky_positive(eigenvalues, positive):
    q, _ = np.linalg.qr(matrix(3))
    a = q @ np.diag(eigenvalues) @ q.T
    assert bool(cholesky_positive(jnp.asarray((a + a.T) / 2))) is positive


def test_cholesky_positive_refuses_zero_pivots_and_nan():
    for a in (
        np.zeros((2, 2)),
        [[0.0, 1.0], [1.0, 0.0]],
        [[1.0, 0.0], [0.0, 0.0]],
        np.full((2, 2), np.nan),
    ):
        assert not bool(cholesky_positive(jnp.asarray(a)))


@pytest.mark.parametrize(("rows", "cols"), [(5, 2), (4, 1), (6, 5), (3, 0)])
def test_left_null_space(rows, cols):
    a = np.random.default_rng(rows).normal(size=(rows, cols))
    basis, inverse = (np.asarray(v) for v in left_null_space(jnp.asarray(a)))
    assert basis.shape == (rows - cols, rows) and inverse.shape == (cols, rows)
    # Products of matrices of order 1 to 100, each entry rounded a few times.
    np.testing.assert_allclose(basis @ a, np.zeros((rows - cols, cols)), atol=1e-13)
    np.testing.assert_allclose(inverse @ a, np.eye(cols), atol=1e-13)
    assert np.linalg.matrix_rank(basis) == rows - cols


def test_left_null_space_eliminates_by_unit_columns():
    # Rows that carry no nu stay as they are: what eliminating nu by hand gives.
    a = jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [3.0, 4.0]])
    basis, _ = left_null_space(a)
    np.testing.assert_array_equal(basis[0], [1.0, 0.0, 0.0, 0.0])
