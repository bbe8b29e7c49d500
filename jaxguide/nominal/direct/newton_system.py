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
import jax.numpy as jnp
from jaxtyping import Array, Float

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
    A, B = (jnp.asarray(a, delta.dtype) for a in (rule.A, rule.B))
    dq, db = program.inputs(dw), program.end_inputs(dw)
    on_q, on_b, on_support = forces(program, system.nodes, system.ends, y, 0.0)
    on_q = on_q + jnp.einsum("skab,skb->ska", system.node_hessian, dq)
    on_b = on_b + system.end_hessian @ db
    force = gather(program, dw, on_q, on_b, on_support)
    force = force._replace(u=force.u + program.roughness(dw.u))
    springs = lambda f, s, d, g: jnp.where(g, 0.0, f + (s + delta) * d)
    own = jax.tree_util.tree_map(springs, force, system.sigma, dw, system.given)
    slack = lambda y, s, d, g: jnp.where(g, 0.0, -y + s * d)
    force = own._replace(
        path=slack(y.path, system.sigma.path, dw.path, system.given.path),
        end=slack(y.end, system.sigma.end, dw.end, system.given.end),
    )
    e_b = system.ends.jacobian[1:]
    defect = jnp.einsum("rp,spn->srn", A, program.support(dw))
    defect = defect - jnp.einsum("rk,skna,ska->srn", B, J[:, :, :n], dq)
    path = jnp.einsum("skha,ska->skh", J[:, :, n + 1 :], dq) - dw.path - COMPLIANCE * y.path
    return Load(force, Equations(defect, path, e_b @ db - dw.end))


def forces(
    program: Transcription, nodes: Nodes, ends: Ends, y: Equations, cost: float
) -> tuple[Float[Array, "segment node in"], Float[Array, " end"], Float[Array, "segment point n"]]:
    """Derivatives of `cost` f + y^T c with respect to the nodes' inputs, the endpoint inputs and
    (of the defects' part A X alone) the states at the support points."""
    n = program.counts.n
    weights = program.node_weights(y).at[:, :, n].set(cost)
    on_q = jnp.einsum("sko,skoa->ska", weights, nodes.jacobian)
    on_b = cost * ends.jacobian[0] + y.end @ ends.jacobian[1:]
    A = jnp.asarray(program.rule.A, y.defect.dtype)
    return on_q, on_b, jnp.einsum("rp,srn->spn", A, y.defect)


def gather(
    program: Transcription, like: Primal, on_q: Array, on_b: Array, on_support: Array
) -> Primal:
    """`forces` as derivatives with respect to the unknowns themselves, shaped `like` a Primal."""

    def spread(w: Primal) -> tuple[Array, Array, Array]:
        return program.inputs(w), program.end_inputs(w), program.support(w)

    return jax.linear_transpose(spread, like)((on_q, on_b, on_support))[0]


@jax.jit
def lagrangian_gradient(
    program: Transcription, nodes: Nodes, ends: Ends, w: Primal, y: Equations
) -> Primal:
    """Gradient of the Lagrangian f + y^T c, from Jacobians at hand; of f, if y is zero."""
    on_unknowns = gather(program, w, *forces(program, nodes, ends, y, 1.0))
    on_controls = on_unknowns.u + program.roughness(w.u)
    return on_unknowns._replace(u=on_controls, path=-y.path, end=-y.end)
