"""The unknowns of a transcription, its equations, and the units both are scaled by."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.problem import Problem, count


class Primal(NamedTuple):
    """The unknowns, scaled. Segments share their ends: `x` holds what follows each one's first."""

    x0: Float[Array, " n"]
    x: Float[Array, "segment after n"]
    u: Float[Array, "segment node m"]
    times: Float[Array, " clock"]  # t0, tf, free knots
    p: Float[Array, " parameter"]  # static parameters
    path: Float[Array, "segment node h"]  # slacks: what the path constraints should equal
    end: Float[Array, " q"]  # slacks of the endpoint constraints


def flattened(w: Primal) -> Array:
    """All entries as one vector."""
    return jnp.concatenate([a.reshape(-1) for a in w])


class Rows(NamedTuple):
    """One number for each equality constraint: its residual c, which vanishes, or its multiplier y
    in the scaled Lagrangian f + y^T c."""

    defect: Float[Array, "segment row n"]
    path: Float[Array, "segment node h"]
    end: Float[Array, " q"]


class Scale(NamedTuple):
    """Designer units: user units = scale times the solver's."""

    x: Float[Array, " n"]
    u: Float[Array, " m"]
    t: Float[Array, ""]
    p: Float[Array, " parameter"]
    path: Float[Array, " h"]
    end: Float[Array, " q"]
    objective: Float[Array, ""]


class Sizes(NamedTuple):
    n: int
    m: int
    parameters: int
    path: int
    end: int
    segments: int
    nodes: int
    after: int  # support points of a segment that follow its first
    times: int


class Arcwise(eqx.Module):
    """What is known of the arc that each segment is part of.

    - `held`: 1 or -1 where a control is to stay at its upper or lower bound, 0 elsewhere. The sign
      of its multiplier tells whether it should.
    - `smooth`: weights of the squares of the upper half of each control's Legendre coefficients,
      added to the objective: for singular arcs, where nothing else keeps a control from
      oscillating. Where the true control is smooth their share of the objective vanishes.
    - `released`: states whose bounds are implied by controls held, and would only have multipliers
      of their own choice; the last point of a segment counts by itself. `unpathed`: likewise path
      constraints.
    """

    held: Float[Array, "segment m"]
    smooth: Float[Array, "segment m"]
    released: Bool[Array, "segment two n"]
    unpathed: Bool[Array, "segment h"]

    @classmethod
    def blank(cls, segments: int, problem: Problem) -> "Arcwise":
        """Nothing known."""
        zero = jnp.zeros((segments, problem.m), jnp.result_type(float))
        released = jnp.zeros((segments, 2, problem.n), bool)
        return cls(
            zero, zero, released, jnp.zeros((segments, count(problem, "path_constraints")), bool)
        )
