"""An iterate, with the problem's functions and derivatives there, and its optimality error."""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.nominal.direct.box import Box, Entries, distances
from jaxguide.nominal.direct.interior_point.state import Kind, Setup, State, kind_of
from jaxguide.nominal.direct.newton_system import lagrangian_gradient
from jaxguide.nominal.direct.transcription import Ends, Nodes
from jaxguide.nominal.direct.trees import entries, largest, one_norm, total
from jaxguide.nominal.direct.unknowns import Equations, flattened

_tree = jax.tree_util.tree_map

# s_max, mean multiplier above which errors are scaled: Waechter & Biegler (2006), after eq. (6).
_S_MAX = 100.0
# Bound on their s_d. Redundant constraints let multipliers, and with them s_d, grow without bound;
# this keeps the Lagrangian's gradient below 1e4 times the tolerance. Chosen, not tuned.
_S_D_MAX = 1e4


class Iterate(NamedTuple):
    """The state, the kind of the step from it, and all that is known there before anything is
    factorised: functions and first derivatives, objective `f`, constraints `c`, distances `low` and
    `high` to the bounds, `error`: mu -> E_mu, and `error_now`: E_0."""

    state: State
    kind: Kind
    nodes: Nodes
    ends: Ends
    f: Float[Array, ""]
    c: Equations
    low: Float[Array, " unknown"]
    high: Float[Array, " unknown"]
    error: Callable[[Array], Array]
    error_now: Float[Array, ""]


def optimality_error(
    box: Box,
    gradient: Entries,
    w: Entries,
    y: Equations,
    zl: Entries,
    zu: Entries,
    c: Equations,
) -> Callable[[Array], Array]:
    """mu -> E_mu, the worst scaled violation of the perturbed first-order conditions; `gradient`:
    of f + y^T c.

    **Source:** Waechter & Biegler (2006), eqs (4) and (5); s_d and s_c, after eq. (6).
    """
    net = _tree(lambda g, a, b: g - a + b, gradient, zl, zu)
    net = _tree(lambda g, given: xp.where(given, 0.0, g), net, box.given)
    low, high = distances(box, w)
    z = total(zl) + total(zu)
    multipliers = one_norm(y) + z
    s_d = xp.maximum(_S_MAX, multipliers / (entries(y) + 2 * entries(w))) / _S_MAX
    s_d = xp.minimum(s_d, _S_D_MAX)
    s_c = xp.maximum(_S_MAX, z / (2 * entries(w))) / _S_MAX
    smooth = xp.maximum(largest(net) / s_d, largest(c))

    def error(mu: Array) -> Array:
        short = lambda a, z, on: xp.where(on, a * z - mu, 0.0)
        below = largest(_tree(short, low, zl, box.below))
        above = largest(_tree(short, high, zu, box.above))
        return xp.maximum(smooth, xp.maximum(below, above) / s_c)

    return error


def evaluated(setup: Setup, s: State) -> Iterate:
    """The iterate of a state."""
    program, box, _ = setup
    w = program.shaped(s.w)
    nodes, ends = program.derivatives(w)
    f, c = program.objective_and_residual(w, (nodes.value, ends.value))
    gradient = flattened(lagrangian_gradient(program, nodes, ends, w, s.y))
    error = optimality_error(box, gradient, s.w, s.y, s.zl, s.zu, c)
    low, high = distances(box, s.w)
    now = error(xp.zeros_like(s.mu))
    return Iterate(s, kind_of(s.mode), nodes, ends, f, c, low, high, error, now)
