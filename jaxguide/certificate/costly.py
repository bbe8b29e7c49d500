"""The costly checks: the control flown through the dynamics, and conjugate points."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxguide.certificate.along import Along
from jaxguide.certificate.table import Checks
from jaxguide.linalg import power_of_two
from jaxguide.neighboring.linearization import terminal_conditions
from jaxguide.neighboring.segmented import NODES, SEGMENTS, SWEEPS, solve_sweeps
from jaxguide.neighboring.sufficiency import conjugate_ahead
from jaxguide.nominal.steps import adaptive
from jaxguide.trajectory import Extremal

# Tolerance and most steps of the adaptive integrator, and the relative error up to which the flown
# states pass, whatever the method's accuracy: three digits above the first. Chosen, not tuned.
_FLOWN_TO, _STEPS, _PASSES = 1e-11, 16384, 1e-8


def propagation(rows: Checks, a: Along) -> None:
    """The extremal's states against those flown with its interpolated control; conjugate points."""
    extremal = a.extremal
    problem, t = extremal.problem, extremal.t
    gap = (_propagate(extremal, a.size.x) - extremal.x) / a.size.x[None]
    rows.add("propagated state", problem.state_names, gap, t, _PASSES)
    # The row is 1, at the last break that has a conjugate point ahead, or 0 without any.
    ahead = _conjugate(extremal)
    last = jnp.where(jnp.any(ahead), ahead.shape[0] - 1 - jnp.argmax(ahead[::-1]), 0)
    count = jnp.any(ahead).astype(t.dtype)
    rows.add_signed("conjugate points", ("one follows",), count, extremal.breaks[last], 0.0)


def _propagate(extremal: Extremal, size: Float[Array, " n"]) -> Float[Array, "node n"]:
    """States flown from x(t0) with the interpolated control, at the nodes. The integrator works in
    units of their `size`, as powers of two, so that its tolerance has none of the user's."""
    problem, unit = extremal.problem, power_of_two(size)
    control = lambda t: extremal.interpolate(extremal.u, t)
    rate = lambda t, y: problem.dynamics(t, y * unit, control(t)) / unit
    t, y = extremal.t, extremal.x[0] / unit
    return adaptive(rate, y, t[0], t[-1], _FLOWN_TO, _STEPS, at=t).ys * unit[None]


def _conjugate(extremal: Extremal) -> Bool[Array, " break"]:
    """Whether a conjugate point lies between each break of the mesh (the last left out) and tf."""
    terminal, times = terminal_conditions(extremal), extremal.breaks[:-1]
    pair = solve_sweeps(extremal, terminal, times, SEGMENTS, NODES, SWEEPS, ())
    return conjugate_ahead(pair.sweep, times)
