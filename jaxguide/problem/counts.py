"""How many components the constraints of a Problem have."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxguide.host.remembered import remembered
from jaxguide.problem.parameters import with_parameters
from jaxguide.problem.statement import Problem


def count(problem: Problem, name: str) -> int:
    """Number of components of `name`: "path_constraints" or "integrands"."""
    return _sizes(*_kind(problem))[name]


def endpoint_count(problem: Problem) -> int:
    """Number of endpoint constraints."""
    return _sizes(*_kind(problem))["endpoint_constraints"]


@remembered
def _kind(problem: Problem) -> tuple[Any, tuple[Any, ...]]:
    leaves, structure = jax.tree_util.tree_flatten(problem)
    return structure, tuple(map(jax.typeof, leaves))


@functools.lru_cache(4096)  # a trace takes a millisecond, and every mesh asks ten times
def _sizes(structure: Any, types: tuple[Any, ...]) -> dict[str, int]:
    """The numbers of components that the constraints have in problems of one kind."""
    dtype = jnp.result_type(float)
    number = lambda *shape: jax.ShapeDtypeStruct(shape, dtype)

    def values(problem: Problem, t: Any, x: Any, u: Any) -> Any:
        stated = with_parameters(problem, None)
        return {
            "path_constraints": stated.path_constraints(t, x, u),
            "integrands": stated.integrands(t, x, u),
            "endpoint_constraints": stated.endpoint_constraints(x, x, t, t),
        }

    like = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in types]
    problem = structure.unflatten(like)
    found = jax.eval_shape(values, problem, number(), number(problem.n), number(problem.m))
    return {name: value.shape[0] for name, value in found.items()}
