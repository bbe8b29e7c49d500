"""The interior-point method's input, output, and state between steps."""

from typing import Any, NamedTuple

from jaxtyping import Bool, Float, Int

from jaxguide.arrays import Array
from jaxguide.nominal.direct.box import Box
from jaxguide.nominal.direct.interior_point.filter import Filter
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.unknowns import Equations, Primal

# Modes, the kind of the next step: Newton's; towards feasibility; an estimate of the multipliers.
NEWTON, RESTORE, ESTIMATE = 0, 1, 2
# Status.
RUNNING, CONVERGED, INFEASIBLE, TOO_MANY, STALLED = 0, 1, 2, 3, 4


class Options(NamedTuple):
    """Runtime arguments: changing them compiles nothing.

    - `tolerance`: of the scaled first-order conditions. `mu`: first value of the barrier.
    - `push`: least distance of the start from the bounds, see `box.inside`.
    - `warm`: whether the start's multipliers are used; otherwise they are estimated.
    """

    tolerance: Any
    mu: Any
    max_iterations: Any
    push: Any
    warm: Any


class Start(NamedTuple):
    """Where to begin: the unknowns and, from a solution nearby, multipliers of the constraints and
    net multipliers (upper less lower) of the bounds."""

    w: Primal
    y: Equations
    net: Primal


class Solution(NamedTuple):
    """Where the iterations ended: unknowns, multipliers of the constraints and of the lower and
    upper bounds, the last barrier, scaled error E_0 and worst constraint."""

    w: Primal
    y: Equations
    zl: Primal
    zu: Primal
    mu: Float[Array, ""]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    error: Float[Array, ""]
    violation: Float[Array, ""]


class Setup(NamedTuple):
    """The problem, fixed during the iterations; the box holds vectors."""

    program: Transcription
    box: Box
    options: Options


class State(NamedTuple):
    """Passed from step to step. Unknowns and bounds' multipliers are vectors: in a loop, each leaf
    of a pytree costs as much as a whole vector.

    - `w`, `y`, `zl`, `zu`, `mu`, `filter`: the iterate, its barrier and filter.
    - `theta_max`, `theta_min`: violations above which no point is acceptable, and below which the
      switching condition counts; Waechter & Biegler (2006), eq. (21), and before eq. (19).
    - `theta_entry`: violation at which restoration began.
    - `delta`: the last regularisation that was needed, delta_w^last of their Algorithm IC.
    - `free`: whether the barrier followed a probe; otherwise it is held until its problem is
      solved. `errors`: E_0 at the last iterates with a free barrier.
    """

    w: Float[Array, " unknown"]
    y: Equations
    zl: Float[Array, " unknown"]
    zu: Float[Array, " unknown"]
    mu: Float[Array, ""]
    filter: Filter
    theta_max: Float[Array, ""]
    theta_min: Float[Array, ""]
    theta_entry: Float[Array, ""]
    delta: Float[Array, ""]
    mode: Int[Array, ""]
    iteration: Int[Array, ""]
    status: Int[Array, ""]
    error: Float[Array, ""]
    free: Bool[Array, ""]
    errors: Float[Array, " memory"]


class Kind(NamedTuple):
    """The kind of a step: exactly one of the three is true."""

    newton: Bool[Array, ""]
    restore: Bool[Array, ""]
    estimate: Bool[Array, ""]

    @property
    def flat(self) -> Bool[Array, ""]:
        """Whether the step uses no curvature of the Lagrangian."""
        return self.restore | self.estimate


def kind_of(mode: Int[Array, ""]) -> Kind:
    """The kind that `mode` names."""
    return Kind(mode == NEWTON, mode == RESTORE, mode == ESTIMATE)
