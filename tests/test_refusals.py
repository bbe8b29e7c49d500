"""Bad input and undefined functions: refused or reported by name, with the remedy."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import DoubleIntegrator, slow

import jaxguide as jg

SMALL: Any = jg.Pseudospectral(nodes=4, segments=2, refinements=0)


class WithOne(DoubleIntegrator):
    state_names = ("x", "v", "w")
    initial_state = (0.0, 0.0, 0.0)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0], -x[2]])

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf[:2] - jnp.stack(self.target)


@pytest.fixture(scope="module")
def solved():
    return jg.solve(DoubleIntegrator(), SMALL)


def test_guesses_are_refused_by_kind(solved):
    solve = lambda guess, problem=None, method=SMALL: jg.solve(
        DoubleIntegrator() if problem is None else problem, method, guess
    )
    with pytest.raises(ValueError, match=r"guess has 2 states; WithOne has 3: \('x', 'v', 'w'\)"):
        solve(solved, WithOne())
    with pytest.raises(ValueError, match="guess has 2 states"):
        solve(solved, WithOne(), jg.Shooting())
    batch = jax.tree_util.tree_map(lambda a: jnp.stack([a, a]), solved)
    with pytest.raises(ValueError, match="batch of 2 extremals; pick one"):
        solve(batch)
    with pytest.raises(ValueError, match="batch of 2 extremals was asked"):
        batch(0.5)
    with pytest.raises(ValueError, match=r"jax.random.key\(seed\)"):
        solve(jax.random.PRNGKey(0))
    with pytest.raises(ValueError, match="random key, which is for jg.Pseudospectral"):
        solve(jax.random.key(0), method=jg.Shooting())
    with pytest.raises(ValueError, match="costates are for jg.Shooting"):
        solve(np.ones(2))
    endless = dataclasses.replace(solved, stretch=jnp.asarray(1.0))
    with pytest.raises(ValueError, match="guess runs to t = inf"):
        solve(endless)


def test_batches_are_refused_by_count(solved):
    lanes = jax.vmap(lambda k: DoubleIntegrator(k=k))
    with pytest.raises(ValueError, match="leading axes have length 0"):
        jg.solve_batch(lanes(jnp.zeros(0)), SMALL)
    pair = jax.tree_util.tree_map(lambda a: jnp.stack([a, a]), solved)
    with pytest.raises(ValueError, match="guess has 2 lanes for 3 problems"):
        jg.solve_batch(lanes(jnp.ones(3)), SMALL, pair)


def test_statements_are_refused():
    with pytest.raises(ValueError, match="final_time is infinite and initial_time is Free"):
        jg.solve(DoubleIntegrator(initial_time=jg.Free(0.0, 1.0), final_time=np.inf), SMALL)

    class Gauged(DoubleIntegrator):
        def integrands(self, t, x, u):
            return x[:1]

    with pytest.raises(ValueError, match="grid 'lgl' collocates at both ends"):
        jg.solve(Gauged(), jg.Pseudospectral(grid="lgl"))


class Root(DoubleIntegrator):
    """Functions that are undefined beyond x = 0.5, or at the end."""

    def path_constraints(self, t, x, u):
        return jnp.sqrt(0.5 - x[:1]) - 3


class Logarithm(DoubleIntegrator):
    def integrands(self, t, x, u):
        return jnp.log(0.5 - x[:1])


class Cost(DoubleIntegrator):
    def endpoint_cost(self, x0, xf, t0, tf):
        return jnp.log(xf[0] - 2)


class Ends(DoubleIntegrator):
    def endpoint_constraints(self, x0, xf, t0, tf):
        return jnp.stack([xf[0] - 1, jnp.sqrt(xf[0] - 2)])


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        slow(Root(), r"path_constraints is nan at node \d+ \(t = "),
        slow(Logarithm(), r"integrands is (nan|-inf) at node \d+"),
        (Cost(), r"endpoint_cost is nan at x0 = "),
        slow(Ends(), r"endpoint_constraints is nan at x0 = "),
    ],
    ids=["path", "integrand", "endpoint-cost", "endpoint-constraint"],
)
def test_undefined_functions_are_named(problem, words):
    with pytest.raises(jg.SolveError, match=words):
        jg.solve(problem, SMALL)


@pytest.mark.slow
def test_an_undefined_cost_is_no_success_of_shooting():
    e = jg.solve(Cost(), jg.Shooting(starts=2, segments=4), throw=False)
    assert e.result == jg.RESULTS.undefined


@pytest.mark.slow
def test_a_trace_reports_what_it_hides():
    """A mesh that should have been refined; an infinite end."""

    class Decay(jg.Problem):
        state_names, control_names = ("x",), ("u",)
        initial_state = (1.0,)
        control_bounds = (-0.3, 0.3)

        def dynamics(self, t, x, u):
            return -x + u

        def running_cost(self, t, x, u):
            return jnp.sum(x**2 + u**2)

    method = dataclasses.replace(SMALL, refinements=1)
    result = jax.jit(lambda p: jg.solve(p, method, throw=False).result)
    as_arrays = lambda p: jax.tree_util.tree_map(jnp.asarray, p)
    assert result(as_arrays(Decay())) == jg.RESULTS.underresolved
    assert result(as_arrays(Decay(final_time=np.inf))) == jg.RESULTS.hidden_horizon
    taken = jax.jit(lambda p: jg.solve(p, SMALL, throw=False).result)
    assert taken(as_arrays(Decay())) == jg.RESULTS.successful
