"""An outsider's node family: written from the docstring of `jg.NodeFamily`, public names alone."""

import textwrap
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import roots_jacobi

import jaxguide as jg


class DoubleIntegrator(jg.Problem):
    """x'' = u from (0, 0) to (1, 0) in one second, the integral of u^2/2 least: u = 6 - 12 t,
    J = 6, costates (-12, -(6 - 12 t))."""

    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 0.0)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0]])

    def running_cost(self, t, x, u):
        return u[0] ** 2 / 2

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf - jnp.array([1.0, 0.0])


def documented() -> jg.NodeFamily:
    """An object of the class that the docstring of `jg.NodeFamily` shows: Fejer's first rule."""
    shown = (jg.NodeFamily.__doc__ or "").split("first rule:")[1].split("jg.solve(")[0]
    names: dict[str, Any] = {"jg": jg, "np": np}
    exec(textwrap.dedent(shown), names)
    return names["Fejer"]()


class Jacobi(jg.NodeFamily):
    """The zeros of the Jacobi polynomial of two equal exponents, with or without the ends: 0 gives
    LG, LGR and LGL, -1/2 the Chebyshev families. Weights by interpolation."""

    exponent: float
    left: bool = False
    right: bool = False
    least = 2

    def nodes(self, n):
        inner = n - self.left - self.right
        a = self.exponent
        x, _ = roots_jacobi(inner, a + self.right, a + self.left)
        x = np.concatenate([[-1.0] * self.left, x, [1.0] * self.right])
        moments = 2 * np.eye(n)[0]  # of the Legendre polynomials
        return x, np.linalg.solve(np.polynomial.legendre.legvander(x, n - 1).T, moments)

    def exact_degree(self, n):
        return 2 * n - 1 - self.left - self.right if self.exponent == 0 else n - 1


def solved(family, nodes, segments=1):
    """The errors of u, x and J, and the extremal."""
    method = jg.Pseudospectral(grid=family, nodes=nodes, segments=segments, refinements=0)
    e = jg.solve(DoubleIntegrator(), method)
    t = np.asarray(e.t)
    of_u = np.max(np.abs(np.asarray(e.u)[:, 0] - (6 - 12 * t)))
    of_x = np.max(np.abs(np.asarray(e.x)[:, 0] - (3 * t**2 - 2 * t**3)))
    return np.array([of_u, of_x, abs(float(e.objective) - 6)]), e


@pytest.mark.slow
def test_the_family_of_the_docstring_converges():
    """Exact to degree n - 1 only: twice the nodes, a quarter of the error of u and a sixteenth of
    those of x and J. A fifth less is allowed for terms of higher order, which fall faster."""
    fejer = documented()
    errors = np.stack([solved(fejer, n)[0] for n in (6, 12, 24)])
    ratios = errors[:-1] / errors[1:]
    assert np.all(ratios > 0.8 * np.array([4, 16, 16])), ratios
    # By experiment 13/n^2 of u, at the ends, where it is extrapolated, and 8/n^4 of J.
    assert np.all(errors[-1, [0, 2]] < [16 / 24**2, 10 / 24**4])


@pytest.mark.slow
@pytest.mark.parametrize(("left", "right"), [(False, True), (True, True)])
def test_gauss_jacobi_is_exact(left, right):
    """With exponent 0 the rule is exact for all that a linear control makes."""
    errors, e = solved(Jacobi(0.0, left, right), 6, 1 if left else 2)
    assert np.max(errors) < 1e-8  # the tolerance of the first-order conditions, 1e-9, times 6
    np.testing.assert_allclose(e.costate[:, 0], -12.0, atol=1e-7)
    assert float(e.residual) < 1e-9


def test_equal_families_share_a_program():
    assert Jacobi(0.0, right=True) == Jacobi(0.0, right=True) != Jacobi(-0.5, right=True)
    assert hash(Jacobi(0.5)) == hash(Jacobi(0.5))


class Descending(Jacobi):
    def nodes(self, n):
        x, w = Jacobi(self.exponent).nodes(n)
        return x[::-1], w


class Doubled(Jacobi):
    def nodes(self, n):
        x, w = Jacobi(self.exponent).nodes(n)
        return x, 2 * w


@pytest.mark.parametrize(
    ("family", "words"),
    [
        (Descending(0.0), "nodes must ascend on"),
        (Doubled(0.0), "weights sum to 4, not to 2, so they do not integrate 1"),
        (Jacobi(0.0), "needs n >= 2"),
        ("gauss", "choose one of lgl, cgl, lgr-left, lgr-right, lg, or .* jg.NodeFamily"),
    ],
)
def test_refused(family, words):
    nodes = 1 if words == "needs n >= 2" else 6
    with pytest.raises(ValueError, match=words):
        jg.Pseudospectral(grid=family, nodes=nodes)
