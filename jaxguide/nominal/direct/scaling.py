"""Designer units of a transcription, from bounds, guess and dynamics."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.conditions.units import REST, natural_units
from jaxguide.nominal.direct.transcription import Transcription, clock_order
from jaxguide.nominal.direct.unknowns import Primal, Scale
from jaxguide.problem import Problem, count, endpoint_count, parameters
from jaxguide.transforms.endless import evened


def unit_scale(problem: Problem, knots: int) -> Scale:
    """User units as they are: every scale 1, of a `problem` with so many free `knots`."""
    path, end = count(problem, "path_constraints"), endpoint_count(problem)
    end += len(clock_order(problem, 2 + knots))
    one = jnp.ones((), jnp.result_type(float))
    many = lambda k: jnp.ones(k, one.dtype)
    return Scale(
        many(problem.n), many(problem.m), one, many(len(parameters(problem))), many(path),
        many(end), one,
    )  # fmt: skip


def designer_units(program: Transcription, w: Primal) -> Scale:
    """Scales of states, controls, times and parameters from bounds and the guess `w`, in user
    units; of constraints and objective from their gradients there."""
    problem, counts, dtype = evened(program.problem), program.counts, program.dtype
    program = eqx.tree_at(lambda q: q.problem, program, problem)
    x, u = natural_units(problem, w.times, w.x0, w.x, w.u)
    span = w.times[1] - w.times[0]
    t = jnp.where(span > 0, span, 1.0)
    p = jnp.where(jnp.abs(w.p) > 0, jnp.abs(w.p), 1.0)
    scale = program.scale._replace(x=x, u=u, t=t, p=p)
    program = eqx.tree_at(lambda q: q.scale, program, scale)
    scaled = jax.tree_util.tree_map(jnp.divide, w, program.units)
    # Also a unit away from the guess: at rest a gradient may vanish.
    away = scaled._replace(x=scaled.x + 1.0, u=scaled.u + 1.0)
    n, weights = counts.n, jnp.asarray(program.rule.w, dtype)[None, :, None]
    steepest = lambda a, axis: jnp.max(
        jnp.where(jnp.isfinite(a), jnp.abs(a), 0.0), axis=axis, initial=0.0
    )

    def slopes(w: Primal) -> tuple[Array, Array, Array]:
        """Largest slopes of path constraints, endpoint cost and constraints, and running cost."""
        nodes, ends = program.derivatives(w)
        path = steepest(nodes.jacobian[:, :, n + 1 :], (0, 1, 3))
        return path, steepest(ends.jacobian, 1), steepest(nodes.jacobian[:, :, n] / weights, None)

    here, there = slopes(scaled), slopes(away)
    path, end = (jnp.where(a > REST * b, a, b) for a, b in zip(here[:2], there[:2], strict=True))
    usable = lambda a: jnp.where(a > 0, a, 1.0)
    objective = usable(jnp.maximum(jnp.maximum(here[2], there[2]), here[1][0]))
    end = usable(end[1:])
    end = end.at[counts.end - len(program.order) :].set(1.0)  # order of times: in units of time
    return scale._replace(path=usable(path), end=end, objective=objective)
