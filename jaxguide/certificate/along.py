"""An extremal evaluated for the checks: at its nodes, and at Gauss points between them."""

from typing import NamedTuple

from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.problem import Problem
from jaxguide.problem.points import end_slopes, integrand_slopes, slopes
from jaxguide.spectral import nodes_lg
from jaxguide.spectral.either import interpolating
from jaxguide.trajectory import Extremal


class Evaluated(NamedTuple):
    """At points of an extremal, "*k" of them: the dynamics and path constraints; H with what the
    integrands add; the gradients of H bar by (x, u, t); the integrands."""

    f: Float[Array, "*k n"]
    path: Float[Array, "*k p"]
    hamiltonian: Float[Array, "*k"]
    by_x: Float[Array, "*k n"]
    by_u: Float[Array, "*k m"]
    by_t: Float[Array, "*k"]
    integrands: Float[Array, "*k r"]


def hamiltonian_along(
    problem: Problem, t: Array, x: Array, u: Array, costate: Array, held: Array
) -> Evaluated:
    """H bar = H + `held`^T (path constraints, states, controls, integrands) and what it consists
    of, at points of any leading axes. Review, H bar."""
    lead, n, m = t.shape, problem.n, problem.m
    x, u, costate, held = (a.reshape(t.size, a.shape[-1]) for a in (x, u, costate, held))
    t = t.reshape(-1)
    at, (gain, gain_by) = slopes(problem, t, x, u), integrand_slopes(problem, t, x, u)
    p = at.path.shape[1]
    of_path, of_own, of_gain = held[:, :p], held[:, p : p + n + m], held[:, p + n + m :]
    dot = lambda by, rows: (by[:, None] @ rows)[:, 0]
    slope = at.cost_by + dot(costate, at.f_by) + dot(of_path, at.path_by) + dot(of_gain, gain_by)
    value = at.cost + xp.sum(costate * at.f, axis=1) + xp.sum(of_gain * gain, axis=1)
    back = lambda a: a.reshape(*lead, *a.shape[1:])
    by_x, by_u = slope[:, :n] + of_own[:, :n], slope[:, n : n + m] + of_own[:, n:]
    return Evaluated(*map(back, (at.f, at.path, value, by_x, by_u, slope[:, -1], gain)))


class Along:
    """Values that several checks share."""

    def __init__(self, extremal: Extremal):
        self.extremal, self.size = extremal, extremal.sizes()
        t, m, problem = extremal.t, extremal.multipliers, extremal.stated
        gauss, weights = (xp.asarray(a, t.dtype) for a in nodes_lg(2 * extremal.degree))
        self.gauss, self.weights, self.breaks = gauss, weights, extremal.breaks
        self.half = xp.diff(self.breaks) / 2
        middle = (self.breaks[1:] + self.breaks[:-1]) / 2
        integral = xp.broadcast_to(m.integral, (len(t), len(m.integral)))
        # Multipliers of H bar, by node.
        held = xp.concatenate([m.path, m.state, m.control, integral], axis=1)
        self.parts = (
            extremal.by_segment(t[:, None])[..., 0],
            extremal.by_segment(extremal.x),
            extremal.control_by_segment(),
            extremal.costate_by_segment(),
            extremal.by_segment(held),
        )
        to_gauss = interpolating(extremal.reference_nodes, gauss)
        times = middle[:, None] + self.half[:, None] * gauss[None, :]
        self.between = (times, *(to_gauss @ a for a in self.parts[1:]))
        self.at_nodes = hamiltonian_along(
            problem, t, extremal.x, extremal.u, extremal.costate, held
        )
        self.at_gauss = hamiltonian_along(problem, *self.between)
        self.at_ends = end_slopes(problem, *self.ends())

    def integrals(self, values: Float[Array, "segment gauss *k"]) -> Float[Array, "segment *k"]:
        """The integral over each segment, from `values` at its Gauss points."""
        sums = xp.einsum("g,sg...->s...", self.weights, values)
        return self.half.reshape(-1, *(1,) * (sums.ndim - 1)) * sums

    def ends(self) -> tuple[Array, Array, Array, Array]:
        """x0, xf, t0, tf."""
        e = self.extremal
        return e.x[0], e.x[-1], e.t[0], e.t[-1]

    def endpoint_gradient(self) -> tuple[Array, Array, Array, Array]:
        """Gradient of Ebar = E + nu^T e (2002 paper, eq. (5)) by each of `ends`."""
        n, nu = self.extremal.problem.n, self.extremal.multipliers.endpoint
        g = self.at_ends.by[0] + nu @ self.at_ends.by[1:]
        return g[:n], g[n + 2 :], g[n], g[n + 1]
