"""What a Problem of the user's is to the programs that call it: its data and its functions, traced
at one point."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxguide.host.fingerprint import Untold, constants, foreign
from jaxguide.problem.parameters import with_parameters
from jaxguide.problem.statement import Problem

# All that this package asks of a Problem besides its functions.
_DATA = (
    "state_names", "control_names", "initial_time", "final_time", "initial_state", "state_bounds",
    "control_bounds", "endpoint_bounds", "path_bounds", "integral_bounds", "n", "m",
    "has_closed_form",
)  # fmt: skip
_ALONG = ("dynamics", "running_cost", "path_constraints", "integrands")
_AT_ENDS = ("endpoint_cost", "endpoint_constraints")


# What Problems of each kind were first. Where that changes within a process, as by a global number,
# JAX still holds traces of parts with the old one, and no program is what its Problem says.
_first: dict[Any, str] = {}


@foreign.register(Problem)
def _told(problem: Problem) -> str:
    leaves, structure = jax.tree_util.tree_flatten(problem)
    try:
        types = tuple(map(jax.typeof, leaves))
        now = constants(_traced(structure, types))
        same = _first.setdefault((structure, types), now) == now
    except Exception as error:  # the user's functions may raise anything, and static fields too
        raise Untold(problem) from error
    if not same:
        raise Untold(problem)
    return now


def _traced(structure: Any, types: tuple[Any, ...]) -> Any:
    """The data and the functions of Problems of one kind, as a Jaxpr of their leaves and what it
    leaves out."""
    like = [jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in types]
    problem = structure.unflatten(like)
    dtype = jnp.result_type(float)
    t, x, u = (jax.ShapeDtypeStruct(s, dtype) for s in ((), (problem.n,), (problem.m,)))
    trace: Callable = eqx.filter_make_jaxpr(_all)
    jaxpr, _, rest = trace(problem, t, x, u)
    return jaxpr, rest, problem.parameter_paths()


def _all(problem: Problem, t: Any, x: Any, u: Any) -> Any:
    stated = with_parameters(problem, None)
    return (
        [getattr(problem, name) for name in _DATA],
        [getattr(stated, name)(t, x, u) for name in _ALONG],
        [getattr(stated, name)(x, x, t, t) for name in _AT_ENDS],
        stated.optimal_control(t, x, x),
    )
