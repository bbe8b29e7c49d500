"""Designer units of a transcription, from bounds, guess and dynamics."""

import dataclasses
import operator

import jax
import numpy as np

from jaxguide.arrays import Array, put, xp
from jaxguide.conditions.units import REST, natural_units
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Primal
from jaxguide.problem.points import Scale
from jaxguide.transforms.endless import evened


def designer_units(program: Transcription, w: Primal) -> Scale:
    """Scales of states, controls, times and parameters from bounds and the guess `w`, in user
    units; of constraints and objective from their gradients there."""
    problem, counts, dtype = evened(program.problem), program.counts, program.dtype
    program = dataclasses.replace(program, problem=problem)
    x, u = natural_units(problem, w.times, w.x0, w.x, w.u)
    span = w.times[1] - w.times[0]
    t = xp.where(span > 0, span, 1.0)
    p = xp.where(xp.abs(w.p) > 0, xp.abs(w.p), 1.0)
    scale = program.scale._replace(x=x, u=u, t=t, p=p)
    program = dataclasses.replace(program, scale=scale)
    scaled = jax.tree_util.tree_map(operator.truediv, w, program.units)
    # Also a unit away from the guess: at rest a gradient may vanish.
    away = scaled._replace(x=scaled.x + 1.0, u=scaled.u + 1.0)
    n, weights = counts.n, xp.asarray(program.rule.w, dtype)[None, :, None]
    steepest = lambda a, axis: xp.max(
        xp.where(xp.isfinite(a), xp.abs(a), 0.0), axis=axis, initial=0.0
    )

    def slopes(w: Primal) -> tuple[Array, Array, Array]:
        """Largest slopes of path constraints, endpoint cost and constraints, and running cost."""
        nodes, ends = program.derivatives(w)
        path = steepest(nodes.jacobian[:, :, n + 1 :], (0, 1, 3))
        return path, steepest(ends.jacobian, 1), steepest(nodes.jacobian[:, :, n] / weights, None)

    here, there = slopes(scaled), slopes(away)
    path, end = (xp.where(a > REST * b, a, b) for a, b in zip(here[:2], there[:2], strict=True))
    usable = lambda a: xp.where(a > 0, a, 1.0)
    objective = usable(xp.maximum(xp.maximum(here[2], there[2]), here[1][0]))
    end = usable(end[1:])
    end = put(end, np.s_[counts.end - len(program.order) :], 1.0)
    return scale._replace(path=usable(path), end=end, objective=objective)
