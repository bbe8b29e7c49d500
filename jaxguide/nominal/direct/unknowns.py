"""The unknowns of a transcription, its equations, and the units both are scaled by."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Bool, Float, Shaped

from jaxguide.arrays import Array, xp
from jaxguide.problem import Problem, count


class Primal(NamedTuple):
    """The unknowns, scaled. Neighbouring segments share the point between them, so `x` holds, for
    each segment, the states that follow its first point.

    - `x0`: state at the start of the horizon.
    - `times`: t0, tf, then the free knots.
    - `p`: optimised static parameters.
    - `path`, `end`: slacks, the values that the path and endpoint constraints should equal.
    """

    x0: Float[Array, " n"]
    x: Float[Array, "segment after n"]
    u: Float[Array, "segment node m"]
    times: Float[Array, " clock"]
    p: Float[Array, " parameter"]
    path: Float[Array, "segment node h"]
    end: Float[Array, " q"]


def flattened(w: Primal) -> Shaped[Array, " unknown"]:
    """All entries as one vector; `Transcription.shaped` undoes it."""
    return xp.concatenate([a.reshape(-1) for a in w])


class Equations(NamedTuple):
    """One number for each equality constraint c = 0 of the nonlinear program: its residual c, or
    its multiplier y in the scaled Lagrangian f + y^T c."""

    defect: Float[Array, "segment row n"]
    path: Float[Array, "segment node h"]
    end: Float[Array, " q"]


class Counts(NamedTuple):
    """Numbers of unknowns and equations of a transcription.

    - `n`, `m`: states, controls. `parameters`: optimised static parameters.
    - `path`, `end`: path constraints at a node; endpoint constraints, the order of free times
      among them.
    - `segments`; `nodes`: collocation nodes of a segment; `after`: support points of a segment
      that follow its first; `times`: t0, tf and free knots.
    """

    n: int
    m: int
    parameters: int
    path: int
    end: int
    segments: int
    nodes: int
    after: int
    times: int


class Arcwise(eqx.Module):
    """The known structure of the arc that each segment is part of.

    - `held`: 1 or -1 where a control is to stay at its upper or lower bound, 0 elsewhere. The sign
      of its multiplier tells whether it should.
    - `smooth`: weights of the squares of the upper half of each control's Legendre coefficients,
      added to the objective: for singular arcs, where nothing else keeps a control from
      oscillating. Where the true control is smooth their share of the objective vanishes.
    - `released`: states whose bounds are implied by controls held, so that their multipliers would
      be arbitrary; for the inner points of a segment, and for its last point.
    - `unpathed`: likewise path constraints.
    - `loose`: controls whose lower and upper bound is left out, because the segment ends where they
      meet it: there a barrier would hold them away.
    """

    held: Float[Array, "segment m"]
    smooth: Float[Array, "segment m"]
    released: Bool[Array, "segment two n"]
    unpathed: Bool[Array, "segment h"]
    loose: Bool[Array, "segment two m"]

    @classmethod
    def blank(cls, segments: int, problem: Problem) -> "Arcwise":
        """Nothing known of any of `segments` arcs of `problem`."""
        zero = xp.zeros((segments, problem.m), jnp.result_type(float))
        released = xp.zeros((segments, 2, problem.n), bool)
        return cls(
            zero, zero, released, xp.zeros((segments, count(problem, "path_constraints")), bool),
            xp.zeros((segments, 2, problem.m), bool),
        )  # fmt: skip
