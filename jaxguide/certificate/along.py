"""An extremal evaluated for the checks: at its nodes, and at Gauss points between them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.conditions.hamiltonian import endpoint_lagrangian
from jaxguide.problem import Problem
from jaxguide.spectral import interpolation_matrix, nodes_lg
from jaxguide.trajectory import Extremal


class Along:
    """Values that several checks share, computed while they are traced."""

    def __init__(self, extremal: Extremal):
        self.extremal, self.size = extremal, extremal.sizes()
        t, m = extremal.t, extremal.multipliers
        gauss, weights = (jnp.asarray(a, t.dtype) for a in nodes_lg(2 * extremal.degree))
        self.gauss, self.weights, self.breaks = gauss, weights, extremal.breaks
        self.half = jnp.diff(self.breaks) / 2
        middle = (self.breaks[1:] + self.breaks[:-1]) / 2
        integral = jnp.broadcast_to(m.integral, (len(t), len(m.integral)))
        # By node: (t, x, u, costate, multipliers of H bar).
        self.held = jnp.concatenate([m.path, m.state, m.control, integral], axis=1)
        self.nodes = (t, extremal.x, extremal.u, extremal.costate, self.held)
        self.parts = (
            extremal.by_segment(t[:, None])[..., 0],
            extremal.by_segment(extremal.x),
            extremal.control_by_segment(),
            extremal.costate_by_segment(),
            extremal.by_segment(self.held),
        )
        to_gauss = interpolation_matrix(extremal.reference_nodes, gauss)
        times = middle[:, None] + self.half[:, None] * gauss[None, :]
        between = (jnp.einsum("gp,spk->sgk", to_gauss, a) for a in self.parts[1:])
        self.between = (times, *between)

    def at_nodes(self, f: Callable) -> Array:
        """f(problem, t, x, u, costate, held) at every node."""
        return jax.vmap(lambda *at: f(self.extremal.problem, *at))(*self.nodes)

    def at_gauss(self, f: Callable, problem: Problem | None = None) -> Array:
        """The same on the Gauss points of every segment; of another `problem`, if given."""
        of = self.extremal.problem if problem is None else problem
        return jax.vmap(jax.vmap(lambda *at: f(of, *at)))(*self.between)

    def integrals(self, values: Float[Array, "segment gauss *k"]) -> Float[Array, "segment *k"]:
        """The integral over each segment, from `values` at its Gauss points."""
        sums = jnp.einsum("g,sg...->s...", self.weights, values)
        return self.half.reshape(-1, *(1,) * (sums.ndim - 1)) * sums

    def ends(self) -> tuple[Array, Array, Array, Array]:
        """x0, xf, t0, tf."""
        e = self.extremal
        return e.x[0], e.x[-1], e.t[0], e.t[-1]

    def endpoint_gradient(self) -> tuple[Array, Array, Array, Array]:
        """Gradient of Ebar by each of `ends`."""
        g = jax.grad(endpoint_lagrangian, argnums=(2, 3, 4, 5))
        return g(self.extremal.problem, self.extremal.multipliers.endpoint, *self.ends())
