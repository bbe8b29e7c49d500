"""A user's guess as shooting's unknowns: an Extremal, or initial costates flown once."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.nominal.indirect.boundary import Unknowns, horizon
from jaxguide.nominal.indirect.coarse import coarse_ends
from jaxguide.nominal.indirect.starts import random_start
from jaxguide.problem import Problem, endpoint_count, is_free, start_value
from jaxguide.trajectory import Extremal


def unknowns_of(problem: Problem, guess: Any, arcs: int, steps: int, dtype: Any) -> Unknowns:
    """`guess` on `arcs` arcs of `steps` coarse steps each.

    **Raises:** `ValueError` for costates of another shape than (n,).
    """
    if isinstance(guess, Extremal):
        return _of_extremal(problem, guess, arcs)
    costate = jnp.asarray(guess, dtype)
    if costate.shape != (problem.n,):
        raise ValueError(
            f"guess has shape {costate.shape}; give an Extremal or the {problem.n} initial "
            f"costates of {problem.state_names}."
        )
    return _of_costates(problem, costate, arcs, steps)


def _of_extremal(problem: Problem, guess: Extremal, arcs: int) -> Unknowns:
    times = jnp.linspace(guess.t[0], guess.t[-1], arcs + 1)[:-1]
    y = jnp.concatenate([guess.x, guess.costate], axis=1)
    return Unknowns(
        jax.vmap(lambda t: guess.interpolate(y, t))(times),
        guess.multipliers.endpoint,
        _chosen(problem.initial_time, guess.t[0]),
        _chosen(problem.final_time, guess.t[-1]),
    )


def _of_costates(problem: Problem, costate: Array, arcs: int, steps: int) -> Unknowns:
    """Flown once, arc by arc; nu from the transversality condition at the end of the flight, by
    least squares."""
    n, dtype = problem.n, costate.dtype
    x0 = random_start(problem, jax.random.key(0), 1, 1, dtype).starts[0, :n]
    z = Unknowns(
        jnp.concatenate([x0, costate])[None],
        jnp.zeros((endpoint_count(problem),), dtype),
        _chosen(problem.initial_time, jnp.asarray(start_value(problem.initial_time), dtype)),
        _chosen(problem.final_time, jnp.asarray(start_value(problem.final_time), dtype)),
    )
    starts = []
    for k in range(arcs):
        starts.append(z.starts[0])
        end = coarse_ends(_window(problem, z, k, arcs), z, steps)[0, : 2 * n]
        z = z._replace(starts=end[None])
    t0, tf = horizon(problem, z)
    xf, lamf = z.starts[0, :n], z.starts[0, n:]
    j_e = jax.jacfwd(problem.endpoint_constraints, argnums=1)(x0, xf, t0, tf)
    g_e = jax.grad(problem.endpoint_cost, argnums=1)(x0, xf, t0, tf)
    nu = jnp.linalg.lstsq(j_e.T, lamf - g_e)[0] if j_e.shape[0] else z.nu
    return z._replace(starts=jnp.stack(starts), nu=nu)


def _chosen(entry: Any, value: Array) -> Array:
    """A free time as an unknown (1,); none (0,) where it is given."""
    return value[None] if is_free(entry) else jnp.zeros((0,), value.dtype)


def _window(problem: Problem, z: Unknowns, k: int, arcs: int) -> Problem:
    """`problem` over arc `k` alone."""
    t0, tf = horizon(problem, z)
    a, b = t0 + (tf - t0) * k / arcs, t0 + (tf - t0) * (k + 1) / arcs
    where = lambda p: (p.initial_time, p.final_time)
    return eqx.tree_at(where, problem, (a, b), is_leaf=lambda v: v is None or is_free(v))
