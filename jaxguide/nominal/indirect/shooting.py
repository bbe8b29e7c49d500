"""Indirect multiple shooting: the necessary conditions solved to rounding, differentiably."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxguide.host.compilation import brisk_compilation
from jaxguide.host.executables import kept
from jaxguide.nominal.indirect.boundary import Unknowns
from jaxguide.nominal.indirect.coarse import CONVERGED, damped_newton
from jaxguide.nominal.indirect.guess import unknowns_of
from jaxguide.nominal.indirect.laying import laid_mesh
from jaxguide.nominal.indirect.shot import shot
from jaxguide.nominal.indirect.starts import random_start
from jaxguide.nominal.method import Capabilities, Method, called
from jaxguide.problem import Problem
from jaxguide.trajectory import Extremal


class Shooting(Method):
    """Single (`arcs=1`) or multiple indirect shooting.

    Three stages, each in fixed shapes: damped Newton with coarse steps, from the guess or from
    `starts` random flights at once, the best converged one kept; an adaptive flight of it
    (Diffrax's Dopri8 at `tolerance`), whose steps lay the mesh; and Newton with Dopri8
    steps on that mesh, through which derivatives are implicit, forward and reverse: NaN where it
    did not converge.

    **Arguments:**

    - `arcs`: shooting arcs; 1 is single shooting. More arcs tolerate unstable dynamics.
    - `segments`, `degree`: the mesh of the returned Extremal (`segments` a multiple of `arcs`).
    - `tolerance`: relative and absolute, of the integration that lays the mesh.
    - `coarse_steps`: of the first stage, over the horizon.
    - `starts`, `seed`: how many random starts when no guess is given.

    **Error:** boundary conditions to about 1e-12 of their scale; the Certificate tells.
    """

    arcs: int = eqx.field(static=True, default=4)
    segments: int = eqx.field(static=True, default=32)
    degree: int = eqx.field(static=True, default=12)
    tolerance: float = eqx.field(static=True, default=1e-13)
    starts: int = eqx.field(static=True, default=32)
    coarse_steps: int = eqx.field(static=True, default=96)
    seed: int = eqx.field(static=True, default=0)
    max_steps: int = eqx.field(static=True, default=1024)
    quick = True  # and no slower, by experiment on Earth-Mars
    accuracy: ClassVar[float] = 1e-9
    capabilities: ClassVar[Capabilities] = Capabilities(
        direct=False, array_guess="the initial costates"
    )

    def __check_init__(self):
        if self.arcs < 1 or self.segments < 1 or self.segments % self.arcs:
            raise ValueError(
                f"Shooting: segments={self.segments} must be a multiple of arcs={self.arcs} >= 1."
            )
        for name in ("starts", "coarse_steps", "max_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"Shooting: {name}={getattr(self, name)}; need at least 1.")
        if self.degree < 2:
            raise ValueError(f"Shooting: degree={self.degree}; need at least 2.")
        if not 0 < self.tolerance < 1:
            raise ValueError(f"Shooting: tolerance={self.tolerance}; give one in (0, 1).")

    def __call__(self, problem: Problem, guess: Any) -> Extremal:
        dtype = jnp.result_type(float)
        frozen = jax.lax.stop_gradient(problem)
        z = self._from_starts(frozen, dtype) if guess is None else self._near(frozen, guess, dtype)
        z = jax.lax.stop_gradient(z)
        z, breaks = jax.lax.stop_gradient(
            laid_mesh(frozen, z, self.arcs, self.segments, self.tolerance, self.max_steps)
        )
        return shot(problem, z, breaks, self.arcs, self.degree)

    def run(self, problem: Problem, guess: Any) -> Extremal:
        return shooting_program(self, problem, guess)

    @property
    def _arc_steps(self) -> int:
        return -(-self.coarse_steps // self.arcs)

    def _from_starts(self, problem: Problem, dtype: Any) -> Unknowns:
        """The cheapest of the random starts that converge; if none does, the nearest to it."""
        keys = jax.random.split(jax.random.key(self.seed), self.starts)

        def attempt(key: Array) -> tuple[Unknowns, Array, Array]:
            z = random_start(problem, key, self.arcs, self._arc_steps, dtype)
            return damped_newton(problem, z, self._arc_steps)

        zs, left, costs = jax.vmap(attempt)(keys)
        left = jnp.where(jnp.isfinite(left), left, jnp.inf)
        converged = (left < CONVERGED) & jnp.isfinite(costs)
        by_cost = jnp.argmin(jnp.where(converged, costs, jnp.inf))
        best = jnp.where(jnp.any(converged), by_cost, jnp.argmin(left))
        return jax.tree_util.tree_map(lambda a: a[best], zs)

    def _near(self, problem: Problem, guess: Any, dtype: Any) -> Unknowns:
        """`guess` as unknowns, improved by the coarse Newton where that converges."""
        z = unknowns_of(problem, guess, self.arcs, self._arc_steps, dtype)
        better, left, _ = damped_newton(problem, z, self._arc_steps)
        return jax.tree_util.tree_map(lambda a, b: jnp.where(left < CONVERGED, a, b), better, z)


shooting_program = kept(called, brisk_compilation)
"""`Shooting` as one program, which compiles for longer than it runs in some twenty solves."""
