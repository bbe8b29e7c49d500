"""Trajectories on a piecewise polynomial mesh, and extremals: trajectories with costates."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, put
from jaxguide.bounds import bounds_of, size_along
from jaxguide.conditions.control import polish_control
from jaxguide.conditions.sizes import Sizes, sizes_of
from jaxguide.host.remembered import remembered
from jaxguide.problem import Chosen, Problem
from jaxguide.spectral import interpolate
from jaxguide.types import RESULTS


class Point(NamedTuple):
    """State, control and costate at one time (or stacked over times)."""

    x: Array
    u: Array
    costate: Array


class Multipliers(eqx.Module):
    """Multipliers of an extremal's constraints: <= 0 at lower, >= 0 at upper bounds."""

    endpoint: Float[Array, " q"]
    path: Float[Array, "node p"]
    state: Float[Array, "node n"]
    control: Float[Array, "node m"]
    integral: Float[Array, " r"]


class Trajectory(eqx.Module):
    """State and control at nodes: segments that share their ends, each a polynomial.

    Segment s holds nodes s (p - 1) ... (s + 1)(p - 1), placed like `reference_nodes` (p,) of
    [-1, 1], both ends included. Polynomials are in time; on an infinite horizon, whose last node
    is at t = inf, in s with t = t0 + stretch (1 + s)/(1 - s).
    """

    t: Float[Array, " node"]
    x: Float[Array, "node n"]
    u: Float[Array, "node m"]
    reference_nodes: Float[Array, " p"]
    stretch: Float[Array, ""] | None = eqx.field(default=None, kw_only=True)

    @property
    def breaks(self) -> Float[Array, " edge"]:
        """Times at which the segments begin, and the end of the last."""
        return self.t[:: self.reference_nodes.shape[0] - 1]

    @property
    def degree(self) -> int:
        """Degree of each segment's polynomial."""
        return self.reference_nodes.shape[0] - 1

    def by_segment(self, values: Float[Array, "node k"]) -> Float[Array, "segment p k"]:
        """Nodal values gathered segment by segment, shared ends repeated."""
        p = self.reference_nodes.shape[0]
        segments = (self.t.shape[0] - 1) // (p - 1)
        index = np.arange(segments)[:, None] * (p - 1) + np.arange(p)[None, :]
        return values[index]

    def interpolate(self, values: Float[Array, "node *k"], t: Any) -> Array:
        """The polynomial through the nodal `values` at the scalar `t`; held beyond the ends."""
        p = self.reference_nodes.shape[0]
        return self._at(lambda s: jax.lax.dynamic_slice_in_dim(values, s * (p - 1), p), t)

    def _interpolate(self, parts: Float[Array, "segment p k"], t: Any) -> Array:
        """As `interpolate`, of values that may jump at the breaks."""
        return self._at(lambda s: parts[s], t)

    def largest(self, values: Float[Array, "node k"], t: Any) -> Float[Array, " k"]:
        """The largest nodal `values` of the segment that `t` is in."""
        p = self.reference_nodes.shape[0]
        s = self._segment(self.clock(jnp.asarray(t, self.t.dtype)), self.clock(self.breaks))
        return jnp.max(jax.lax.dynamic_slice_in_dim(values, s * (p - 1), p), axis=0)

    def _segment(self, t: Array, breaks: Array) -> Array:
        return jnp.clip(jnp.searchsorted(breaks, t, side="right") - 1, 0, breaks.shape[0] - 2)

    def _at(self, pick: Callable, t: Any) -> Array:
        t = jnp.clip(jnp.asarray(t, self.t.dtype), self.t[0], self.t[-1])
        t, breaks = self.clock(t), self.clock(self.breaks)
        s = self._segment(t, breaks)
        a, b = breaks[s], breaks[s + 1]
        tau = (2 * t - a - b) / jnp.where(b > a, b - a, 1.0)
        return interpolate(self.reference_nodes, pick(s), tau)

    def clock(self, t: Array) -> Array:
        """The variable of the polynomials at the times `t`: t, or s on an infinite horizon."""
        if self.stretch is None:
            return t
        since = t - self.t[0]
        ends = jnp.isinf(since)
        since = jnp.where(ends, 1.0, since)
        return jnp.where(ends, 1.0, (since - self.stretch) / (since + self.stretch))


class Extremal(Trajectory):
    """A trajectory that meets the necessary conditions, with costates and multipliers.

    Signs: H = F + lambda^T f is minimised; lambda(tf) = dEbar/dxf, lambda(t0) = -dEbar/dx0,
    H(tf) = -dEbar/dtf, H(t0) = dEbar/dt0, with Ebar = E + nu^T e. (The 2002 paper prints
    lambda(tf) = -dPhi/dx in eq. (8), which contradicts its eq. (9) for a minimised H.)
    """

    costate: Float[Array, "node n"]
    final_time: Float[Array, ""]
    objective: Float[Array, ""]
    multipliers: Multipliers
    result: RESULTS
    residual: Float[Array, ""]
    problem: Problem
    # Whether a bound is neither clearly active nor clearly free: derivatives with respect to
    # parameters then lie between the one-sided ones. None: there are no bounds.
    degenerate: Bool[Array, ""] | None = None
    # Control and costate may jump at a break: `u` and `costate` hold what follows it.
    u_before: Float[Array, "segment m"] | None = None
    costate_before: Float[Array, "segment n"] | None = None
    # Whether the control is linear between breaks, its node values optimised: H_u = 0 then holds on
    # average only, and the control between nodes is the line itself.
    parametric: bool = eqx.field(static=True, default=False)
    # Static parameters that the solver chose; `problem` holds their values.
    chosen: Chosen | None = None

    @property
    def stated(self) -> Problem:
        """`problem` with its static parameters as a search for them would start here: the host has
        its functions compiled already."""
        return _stated(self)

    def sizes(self) -> Sizes:
        """How large each quantity is along the extremal: what its errors are relative to."""
        m = self.multipliers
        return sizes_of(self.stated, self.t, self.x, self.u, self.costate, m.integral)

    def control_by_segment(self) -> Float[Array, "segment p m"]:
        """Nodal controls segment by segment, each with its own end."""
        return self._own_ends(self.u, self.u_before)

    def costate_by_segment(self) -> Float[Array, "segment p n"]:
        """Nodal costates segment by segment, each with its own end."""
        return self._own_ends(self.costate, self.costate_before)

    def _own_ends(self, values: Array, before: Array | None) -> Array:
        parts = self.by_segment(values)
        return parts if before is None else put(parts, np.s_[:, -1], before)

    def __call__(self, t: Any) -> Point:
        """State, control and costate at `t`, scalar or (T,); held beyond the horizon.

        The control comes from H_u = 0 at the interpolated state and costate where that is regular
        (one Newton step from its interpolant, so an angle stays unwrapped), unless `parametric` or
        something holds it within the segment: a bound of its own or a path constraint. H includes
        what integral constraints add.
        """
        if self.t.ndim != 1:
            raise ValueError(
                f"a batch of {self.t.shape[0]} extremals was asked for its values at one time; "
                "take jax.vmap(lambda e: e(t))(batch), or one lane: "
                "jax.tree_util.tree_map(lambda a: a[i], batch)."
            )
        t = jnp.asarray(t, self.t.dtype)
        return jax.vmap(_polished, in_axes=(None, 0))(self, t) if t.ndim else _polished(self, t)

    def point(self, t: Any) -> Point:
        """The interpolant at the scalar `t`, its control as interpolated."""
        n, m = self.problem.n, self.problem.m
        if self.u_before is None:
            y = self.interpolate(jnp.concatenate([self.x, self.u, self.costate], axis=1), t)
        else:
            parts = (self.by_segment(self.x), self.control_by_segment(), self.costate_by_segment())
            y = self._interpolate(jnp.concatenate(parts, axis=2), t)
        return Point(y[:n], y[n : n + m], y[n + m :])


@remembered
def _stated(extremal: Extremal) -> Problem:
    if extremal.chosen is None:
        return extremal.problem
    return extremal.chosen.unsettled(extremal.problem)


@jax.jit
def _polished(extremal: Extremal, t: Array) -> Point:
    x, u, costate = extremal.point(t)
    if extremal.parametric or not len(u):
        return Point(x, u, costate)
    t = jnp.clip(t, extremal.t[0], extremal.t[-1])
    problem, integral = extremal.problem, extremal.multipliers.integral
    force = jnp.zeros_like(u)
    if extremal.u_before is not None:  # of a direct solution: something may hold its control
        held = jnp.concatenate([extremal.multipliers.control, extremal.multipliers.path], axis=1)
        largest = extremal.largest(jnp.abs(held), t)
        h_u = jax.jacfwd(problem.path_constraints, argnums=2)(t, x, u)
        force = largest[: len(u)] + largest[len(u) :] @ jnp.abs(h_u)
    size = size_along(extremal.u, problem.control_bounds)  # the same at all times
    polished = polish_control(problem, t, x, u, costate, integral, force, size)
    if extremal.u_before is not None:
        polished = jnp.clip(polished, *bounds_of(problem.control_bounds, len(u), u.dtype))
    return Point(x, polished, costate)
