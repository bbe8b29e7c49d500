"""Designer units of a direct solve, from bounds, guess and dynamics."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.nominal.direct.transcription import Transcription, ordered
from jaxguide.nominal.direct.unknowns import Primal, Scale
from jaxguide.problem import Problem, count, endpoint_count, parameters, with_parameters
from jaxguide.transforms.endless import evened

REST = 1e-8  # a guess below it rests at zero
_FAR = 3  # orders of magnitude from 1 at which a size is not left at 1


def unit_scale(problem: Problem, knots: int) -> Scale:
    path, end = count(problem, "path_constraints"), endpoint_count(problem)
    end += len(ordered(problem, 2 + knots))
    one = jnp.ones((), jnp.result_type(float))
    many = lambda k: jnp.ones(k, one.dtype)
    return Scale(
        many(problem.n), many(problem.m), one, many(len(parameters(problem))), many(path),
        many(end), one,
    )  # fmt: skip


def known_size(lo: Array, hi: Array, seen: Float[Array, "k n"]) -> Float[Array, " n"]:
    """The larger finite bound; else the largest value seen, unless it is at rest; else 0."""
    bounded = jnp.isfinite(lo) & jnp.isfinite(hi)
    wide = jnp.where(bounded, jnp.maximum(jnp.abs(lo), jnp.abs(hi)), 0.0)
    largest = jnp.max(jnp.abs(seen), axis=0)
    return jnp.where(wide > 0, wide, jnp.where(largest > REST, largest, 0.0))


@jax.jit
def natural_units(problem: Problem, w: Primal) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """What a state and a control amount to, in user units: by their bounds or values; where nothing
    is said, 1, unless the dynamics tell that their size is another by far.

    They tell of one unknown from its neighbours: what moves a state of known size by as much within
    the horizon, or how far a state is moved by what is known.
    """
    problem, n, m, dtype = evened(problem), problem.n, problem.m, w.x.dtype
    seen = jnp.concatenate([w.x0[None], w.x.reshape(-1, n)])
    x = known_size(*bounds_of(problem.state_bounds, n, dtype), seen)
    u = known_size(*bounds_of(problem.control_bounds, m, dtype), jnp.zeros((1, m), dtype))
    known = jnp.concatenate([x, u])
    # Small numbers alone are better than nothing.
    small = jnp.concatenate([jnp.max(jnp.abs(seen), axis=0), jnp.zeros(m, dtype)])
    known = jnp.where(jnp.any(known > 0), known, small)
    rate = jax.jacfwd(with_parameters(problem, None).dynamics, argnums=(1, 2))
    ends = w.x[:, -1]
    at = jnp.concatenate(rate(w.times[0], w.x0, w.u[0, 0]), axis=1)[None]
    along = jax.vmap(rate, in_axes=(None, 0, 0))((w.times[0] + w.times[1]) / 2, ends, w.u[:, -1])
    moves = jnp.concatenate([at, jnp.concatenate(along, axis=2)])
    moves = jnp.max(jnp.where(jnp.isfinite(moves), jnp.abs(moves), 0.0), axis=0)
    moves = moves * (w.times[1] - w.times[0])

    def tell(_: Any, size: Array) -> Array:
        mover = jnp.where((size[:n, None] > 0) & (moves > 0), size[:n, None] / moves, jnp.inf)
        mover = jnp.min(mover, axis=0)
        moved = jnp.pad(jnp.max(moves * size[None], axis=1), (0, m))
        told = jnp.where(jnp.isfinite(mover), mover, moved)
        return jnp.where(size > 0, size, told)

    told = jax.lax.fori_loop(0, n + m, tell, known)
    far = (told > 0) & (jnp.abs(jnp.log10(jnp.where(told > 0, told, 1.0))) > _FAR)
    size = jnp.where(known > 0, known, jnp.where(far, told, 1.0))
    return size[:n], size[n:]


def designer_units(program: Transcription, w: Primal) -> Scale:
    """Scales from bounds and the guess; constraints and objective by their gradients there."""
    problem, size, dtype = evened(program.problem), program.sizes, program.dtype
    program = eqx.tree_at(lambda q: q.problem, program, problem)
    x, u = natural_units(problem, w)
    span = w.times[1] - w.times[0]
    t = jnp.where(span > 0, span, 1.0)
    p = jnp.where(jnp.abs(w.p) > 0, jnp.abs(w.p), 1.0)
    scale = program.scale._replace(x=x, u=u, t=t, p=p)
    program = eqx.tree_at(lambda q: q.scale, program, scale)
    scaled = jax.tree_util.tree_map(jnp.divide, w, program.units)
    # A unit away too: at rest a gradient may vanish.
    away = scaled._replace(x=scaled.x + 1.0, u=scaled.u + 1.0)
    n, weights = size.n, jnp.asarray(program.rule.w, dtype)[None, :, None]
    largest = lambda a, axis: jnp.max(
        jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0), axis=axis, initial=0.0
    )

    def slopes(w: Primal) -> tuple[Array, Array, Array]:
        """Of path constraints, endpoint cost and constraints, and running cost."""
        nodes, ends = program.derivatives(w)
        path = largest(nodes.jacobian[:, :, n + 1 :], (0, 1, 3))
        return path, largest(ends.jacobian, 1), largest(nodes.jacobian[:, :, n] / weights, None)

    here, there = slopes(scaled), slopes(away)
    path, end = (jnp.where(a > REST * b, a, b) for a, b in zip(here[:2], there[:2], strict=True))
    usable = lambda a: jnp.where(a > 0, a, 1.0)
    objective = usable(jnp.maximum(jnp.maximum(here[2], there[2]), here[1][0]))
    end = usable(end[1:])
    end = end.at[size.end - len(program.order) :].set(1.0)  # of the knots: in units of time
    return scale._replace(path=usable(path), end=end, objective=objective)
