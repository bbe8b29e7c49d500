"""A method of one's own, written from the docstring of `jg.Method`: linear-quadratic problems,
solved exactly by the transition matrix of their Hamiltonian system."""

# pyright: reportArgumentType=false

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator

import jaxguide as jg


class TransitionMatrix(jg.Method):
    """x' = A x + B u, F = |u|^2/2, from a given state to C x = c at a given time.

    (x, lambda)' = M (x, lambda) with M = [[A, -B B^T], [0, -A^T]], and lambda(tf) = C^T nu: one
    linear system for (lambda(t0), nu). **Source:** Bryson & Ho (1975), section 5.3.
    """

    points: int = eqx.field(static=True, default=13)
    accuracy: ClassVar[float] = 1e-9
    capabilities: ClassVar[jg.Capabilities] = jg.Capabilities(direct=False)

    def check(self, problem: jg.Problem) -> None:
        if isinstance(problem.final_time, jg.Free):
            raise ValueError(f"{type(problem).__name__}.final_time is free; give a number.")

    def __call__(self, problem: jg.Problem, guess: Any) -> jg.Extremal:
        n, m = problem.n, problem.m
        zero_x, zero_u = jnp.zeros(n), jnp.zeros(m)
        t0, tf, x0 = (
            jnp.asarray(v, float)
            for v in (problem.initial_time, problem.final_time, jnp.stack(problem.initial_state))
        )
        A, B = jax.jacfwd(problem.dynamics, argnums=(1, 2))(t0, zero_x, zero_u)
        e = lambda x: problem.endpoint_constraints(x0, x, t0, tf)
        C, c = jax.jacfwd(e)(zero_x), -e(zero_x)
        q = c.shape[0]
        M = jnp.block([[A, -B @ B.T], [jnp.zeros((n, n)), -A.T]])
        flow = lambda t: jax.scipy.linalg.expm(M * (t - t0))
        end = flow(tf)
        # C x(tf) = c and lambda(tf) - C^T nu = 0, both linear in (lambda(t0), nu).
        matrix = jnp.block([[C @ end[:n, n:], jnp.zeros((q, q))], [end[n:, n:], -C.T]])
        right = jnp.concatenate([c - C @ end[:n, :n] @ x0, -end[n:, :n] @ x0])
        solution = jnp.linalg.solve(matrix, right)
        nodes = jnp.cos(jnp.linspace(jnp.pi, 0.0, self.points))
        t = t0 + (tf - t0) * (nodes + 1) / 2
        y = jax.vmap(lambda t: flow(t) @ jnp.concatenate([x0, solution[:n]]))(t)
        x, costate = y[:, :n], y[:, n:]
        # J from lambda^T x: d(lambda^T x)/dt = -|u|^2.
        objective = (jnp.dot(costate[0], x[0]) - jnp.dot(costate[-1], x[-1])) / 2
        none = lambda k: jnp.zeros((self.points, k))
        covectors = jg.Multipliers(solution[n:], none(0), none(n), none(m), jnp.zeros(0))
        good = jnp.all(jnp.isfinite(y))
        return jg.Extremal(
            t=t,
            x=x,
            u=-costate @ B,
            reference_nodes=nodes,
            costate=costate,
            final_time=tf,
            objective=objective,
            multipliers=covectors,
            result=jg.RESULTS.where(good, jg.RESULTS.successful, jg.RESULTS.undefined),
            residual=jnp.max(jnp.abs(e(x[-1]))),
            problem=problem,
        )


OWN = TransitionMatrix()
cost = lambda k: jg.solve(DoubleIntegrator(k=k), OWN, throw=False).objective


def test_solves_with_a_certificate_and_gains():
    e = jg.solve(DoubleIntegrator(), OWN)
    np.testing.assert_allclose(e.objective, 6.0, rtol=1e-13)  # u = 6 - 12 t: a matrix exponential
    np.testing.assert_allclose(e(0.3).u, [6 - 12 * 0.3], rtol=1e-12)
    assert np.all(e.certificate.passed), str(e.certificate)
    np.testing.assert_allclose(jg.gain_schedule(e, [0.5])(0.5), [[-24.0, -8.0]], rtol=1e-9)


@pytest.mark.slow
def test_under_jit_vmap_and_grad():
    # J = 6/k^2.
    np.testing.assert_allclose(jax.jit(cost)(2.0), 1.5, rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(cost)(jnp.array([1.0, 2.0])), [6.0, 1.5], rtol=1e-12)
    np.testing.assert_allclose(jax.grad(cost)(1.0), -12.0, rtol=1e-10)
    ks = jnp.linspace(1.0, 2.0, 3)
    batch = jg.solve_batch(jax.vmap(lambda k: DoubleIntegrator(k=k))(ks), OWN)
    np.testing.assert_allclose(batch.objective, 6 / ks**2, rtol=1e-12)


class Spending(DoubleIntegrator):
    def integrands(self, t, x, u):
        return u**2


def test_refuses_by_capabilities_and_by_its_own_check():
    with pytest.raises(ValueError, match="Spending.integrands: 1 integral .* TransitionMatrix"):
        jg.solve(Spending(), OWN)
    with pytest.raises(ValueError, match="DoubleIntegrator.k is a jg.Free static parameter"):
        jg.solve(DoubleIntegrator(k=jg.Free(0.5, 2.0)), OWN)
    with pytest.raises(ValueError, match="final_time is free; give a number"):
        jg.solve(DoubleIntegrator(final_time=jg.Free(0.5, 2.0)), OWN)
    with pytest.raises(ValueError, match="random key, which is for jg.Pseudospectral"):
        jg.solve(DoubleIntegrator(), OWN, jax.random.key(0))
    bad = jg.solve(DoubleIntegrator(k=0.0), OWN, throw=False)  # out of reach
    assert bool(bad.result == jg.RESULTS.undefined)


@pytest.mark.parametrize("method", [OWN, jg.Shooting(), jg.PiecewiseLinear(5)])
def test_refusals_by_shape_alone_hold_under_a_trace(method):
    def objective(tf):
        return jg.solve(dataclasses.replace(Spending(), final_time=tf), method).objective

    with pytest.raises(ValueError, match="Spending.integrands"):
        jax.eval_shape(objective, 1.0)
