"""Whether a structure of arcs is right: what its bounds and their multipliers say."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.bounded import bound_errors
from jaxguide.trajectory import Extremal


@eqx.filter_jit
def worst_bound_errors(extremal: Extremal) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The largest overstep of a bound or path constraint, and the largest complementarity, over all
    nodes: the values of these rows of the certificate."""
    e, m = extremal, extremal.multipliers
    found = bound_errors(e.problem, e.t, e.x, e.u, (m.path, m.state, m.control), e.sizes())
    over = [jnp.max(a, initial=0.0) for a in (found.path, found.state, found.control)]
    complementarity = jnp.max(jnp.abs(found.complementarity), initial=0.0)
    return jnp.max(jnp.stack(over)), complementarity
