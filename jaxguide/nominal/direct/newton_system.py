"""The Newton system of a transcription: its matrix by parts, its right-hand side, their product.

    [ W + Sigma   J^T ] [ dw ]     [ force    ]
    [ J          -C   ] [ y  ] = - [ residual ]

with the Hessian W of the Lagrangian, the barrier's curvature Sigma and the constraints' Jacobian J.
C is zero but for the path constraints, which are springs of compliance `COMPLIANCE`. Nothing is
factorised here: `kkt_factor` does that.

**Source:** Waechter & Biegler (2006), eqs (11) and (13).
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, added, on_numpy, put, traced_once, xp
from jaxguide.nominal.direct.transcription import Ends, Nodes, Transcription
from jaxguide.nominal.direct.unknowns import Equations, Primal

# Compliance of path constraints: an equality is a spring of stiffness 1/COMPLIANCE. It regularises
# as delta_c of Waechter & Biegler (2006), eq. (13) and section 3.1, who take 1e-8 mu^(1/4), and
# only where the matrix is singular.
COMPLIANCE = 1e-8


class NewtonSystem(NamedTuple):
    """The matrix: derivatives at the iterate, and the barrier's curvature.

    - `sigma`: z_l/(w - l) + z_u/(u - w), Waechter & Biegler (2006), after eq. (11).
    - `given`: bool, entries that must not move.
    """

    nodes: Nodes
    ends: Ends
    node_hessian: Float[Array, "segment node in in"]
    end_hessian: Float[Array, "end end"]
    sigma: Primal
    given: Primal


class Load(NamedTuple):
    """The right-hand side, negated: the gradient of the barrier function, without the constraints'
    terms, and the residuals of the constraints."""

    force: Primal
    residual: Equations


class Step(NamedTuple):
    """Change of the unknowns, and the multipliers (not their change) after it."""

    primal: Primal
    dual: Equations


def times_step(
    program: Transcription, system: NewtonSystem, delta: Float[Array, ""], step: Step
) -> Load:
    """The matrix, with `delta` I added to W, times a step: without any elimination, so that
    iterative refinement and implicit derivatives may measure by it."""
    n = program.counts.n
    dw, y = step
    J, rule = system.nodes.jacobian, program.rule
    A, B = (xp.asarray(a, delta.dtype) for a in (rule.A, rule.B))
    dq, db = program.inputs(dw), program.end_inputs(dw)
    on_q, on_b, on_support = forces(program, system.nodes, system.ends, y, 0.0)
    on_q = on_q + (system.node_hessian @ dq[..., None])[..., 0]
    on_b = on_b + system.end_hessian @ db
    force = gather(program, dw, on_q, on_b, on_support)
    force = force._replace(u=force.u + program.roughness(dw.u))
    springs = lambda f, s, d, g: xp.where(g, 0.0, f + (s + delta) * d)
    own = jax.tree_util.tree_map(springs, force, system.sigma, dw, system.given)
    slack = lambda y, s, d, g: xp.where(g, 0.0, -y + s * d)
    force = own._replace(
        path=slack(y.path, system.sigma.path, dw.path, system.given.path),
        end=slack(y.end, system.sigma.end, dw.end, system.given.end),
    )
    e_b = system.ends.jacobian[1:]
    df = (J @ dq[..., None])[..., 0]  # of rates, running cost and path constraints
    defect = A @ program.support(dw) - B @ df[:, :, :n]
    path = df[:, :, n + 1 :] - dw.path - COMPLIANCE * y.path
    return Load(force, Equations(defect, path, e_b @ db - dw.end))


def forces(
    program: Transcription, nodes: Nodes, ends: Ends, y: Equations, cost: float
) -> tuple[Float[Array, "segment node in"], Float[Array, " end"], Float[Array, "segment point n"]]:
    """Derivatives of `cost` f + y^T c with respect to the nodes' inputs, the endpoint inputs and
    (of the defects' part A X alone) the states at the support points."""
    n = program.counts.n
    weights = put(program.node_weights(y), np.s_[:, :, n], cost)
    on_q = (weights[:, :, None] @ nodes.jacobian)[:, :, 0]
    on_b = cost * ends.jacobian[0] + y.end @ ends.jacobian[1:]
    A = xp.asarray(program.rule.A, y.defect.dtype)
    return on_q, on_b, A.T @ y.defect


def gather(
    program: Transcription, like: Primal, on_q: Array, on_b: Array, on_support: Array
) -> Primal:
    """`forces` as derivatives with respect to the unknowns themselves, shaped `like` a Primal."""
    if on_numpy(on_q):
        return _gathered(program, like, on_q, on_b, on_support)

    def spread(w: Primal) -> tuple[Array, Array, Array]:
        return program.inputs(w), program.end_inputs(w), program.support(w)

    return jax.linear_transpose(spread, like)((on_q, on_b, on_support))[0]


def _gathered(
    program: Transcription, like: Primal, on_q: Array, on_b: Array, on_support: Array
) -> Primal:
    """`gather` by hand: the transposes of `inputs`, `end_inputs` and `support`."""
    rule, n, m = program.rule, program.counts.n, program.counts.m
    clock, last = len(like.times), len(on_b) - n
    on_x = added(on_support, np.s_[:, rule.first : rule.first + program.points], on_q[:, :, :n])
    x = added(on_x[:, 1:], np.s_[:-1, -1], on_x[1:, 0])
    x = added(x, np.s_[-1, -1], on_b[last:])
    on_clock = np.sum(on_q[:, :, n + m : n + m + 2], axis=1)
    times = np.einsum("sec,se->c", program.clocks, on_clock) + on_b[n : n + clock]
    p = np.sum(on_q[:, :, n + m + 2 :], axis=(0, 1)) + on_b[n + clock : last]
    none = lambda a: np.zeros_like(a)
    u = on_q[:, :, n : n + m]
    return Primal(on_x[0, 0] + on_b[:n], x, u, times, p, none(like.path), none(like.end))


@traced_once
def lagrangian_gradient(
    program: Transcription, nodes: Nodes, ends: Ends, w: Primal, y: Equations
) -> Primal:
    """Gradient of the Lagrangian f + y^T c, from Jacobians at hand; of f, if y is zero."""
    on_unknowns = gather(program, w, *forces(program, nodes, ends, y, 1.0))
    on_controls = on_unknowns.u + program.roughness(w.u)
    return on_unknowns._replace(u=on_controls, path=-y.path, end=-y.end)
