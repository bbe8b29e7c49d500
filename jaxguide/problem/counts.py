"""How many components the constraints of a Problem have."""

import jax
import jax.numpy as jnp

from jaxguide.problem.parameters import with_parameters
from jaxguide.problem.statement import Problem


def count(problem: Problem, name: str) -> int:
    """Number of components of `name`: "path_constraints" or "integrands"."""
    dtype = jnp.result_type(float)
    t, x, u = (jax.ShapeDtypeStruct(s, dtype) for s in ((), (problem.n,), (problem.m,)))
    return jax.eval_shape(getattr(with_parameters(problem, None), name), t, x, u).shape[0]


def endpoint_count(problem: Problem) -> int:
    """Number of endpoint constraints."""
    dtype = jnp.result_type(float)
    t, x = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct((problem.n,), dtype)
    problem = with_parameters(problem, None)
    return jax.eval_shape(problem.endpoint_constraints, x, x, t, t).shape[0]
