"""Whether a structure of arcs is right: what its bounds and their multipliers say."""

from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.conditions.bounded import bound_errors
from jaxguide.trajectory import Extremal


def worst_bound_errors(extremal: Extremal) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The largest overstep of a bound or path constraint, and the largest complementarity, over all
    nodes: the values of these rows of the certificate."""
    e, m = extremal, extremal.multipliers
    found = bound_errors(e.stated, e.t, e.x, e.u, (m.path, m.state, m.control), e.sizes())
    over = [xp.max(a, initial=0.0) for a in (found.path, found.state, found.control)]
    complementarity = xp.max(xp.abs(found.complementarity), initial=0.0)
    return xp.max(xp.stack(over)), complementarity
