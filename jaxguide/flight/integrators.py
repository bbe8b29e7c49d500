"""How a flight is integrated across one sample."""

import abc
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.laws.lanes import Lanes, lanes
from jaxguide.types import RESULTS

Rate = Callable[[Any, Any, Any], Any]  # (t, x, u) -> dx/dt


class Integrator(eqx.Module):
    """Abstract: see RungeKutta4 and Adaptive."""

    @property
    @abc.abstractmethod
    def stages(self) -> tuple[float, ...] | None:
        """Fractions of the sample at which the control is asked; None if not known ahead."""


class RungeKutta4(Integrator):
    """The classical fourth-order method, `steps` equal steps a sample. Made for batches."""

    steps: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        if self.steps < 1:
            raise ValueError(f"RungeKutta4: steps is {self.steps}; give at least 1.")

    @property
    def stages(self) -> tuple[float, ...]:
        return tuple(i / (2 * self.steps) for i in range(2 * self.steps + 1))

    def across(
        self,
        rate: Rate,
        t: Any,
        width: Any,
        x: Lanes,
        nominal: tuple[Lanes, ...],
        deviation: tuple[Lanes, ...],
    ) -> Lanes:
        """State after the sample, from the controls at its stage times (`stages`); a `deviation`
        of one entry is held over the sample.

        The four stages are a scan: XLA's CPU backend recomputes shared work in every output of a
        fused loop, and a loop carry is the one cut it respects (unrolled, this is ten times
        slower). Each sum adds the slope of the turn before, which is at hand.
        """
        h = width / self.steps
        held = deviation[0] if len(deviation) == 1 else None
        order = [[2 * i, 2 * i + 1, 2 * i + 1, 2 * i + 2] for i in range(self.steps)]
        by_stage = lambda entries: _stack([_stack([entries[j] for j in row]) for row in order])
        controls = (by_stage(nominal),) + (() if held is not None else (by_stage(deviation),))
        starts = [t + i * h for i in range(self.steps)]
        rows = (jnp.stack([jnp.stack([s, s + h / 2, s + h / 2, s + h]) for s in starts]), controls)
        weights = (
            jnp.stack([0 * h, h / 2, h / 2, h]),
            jnp.stack([0 * h, h / 6, h / 3, h / 3]),
        )

        def step(x: Lanes, row: tuple) -> tuple[Lanes, None]:
            zero = tuple(jnp.zeros_like(v) for v in x)

            def stage(carry: tuple, row: tuple) -> tuple[tuple, None]:
                total, k = carry
                s, parts, a, w = row
                u = _move(parts[0], 1.0, parts[1] if held is None else held)
                return (_move(total, w, k), rate(s, _move(x, a, k), u)), None

            (total, k), _ = jax.lax.scan(stage, (x, zero), (*row, *weights))
            return _move(total, h / 6, k), None

        return jax.lax.scan(step, x, rows, unroll=min(self.steps, 2))[0]


class Adaptive(Integrator):
    """Diffrax's Dopri8 to a tolerance: reference flights, one at a time."""

    tolerance: float = eqx.field(static=True, default=1e-11)
    max_steps: int = eqx.field(static=True, default=1024)

    def __check_init__(self):
        if not 0 < self.tolerance < 1:
            raise ValueError(f"Adaptive: tolerance is {self.tolerance}; give one in (0, 1).")
        if self.max_steps < 1:
            raise ValueError(f"Adaptive: max_steps is {self.max_steps}; give at least 1.")

    @property
    def stages(self) -> None:
        return None

    def across(
        self, rate: Any, t: Any, end: Any, x: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], RESULTS]:
        """State at `end`, flown from `t` with dx/dt = rate(t, x)."""
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, x, args: rate(t, x)),
            diffrax.Dopri8(),
            t,
            end,
            None,
            x,
            stepsize_controller=diffrax.PIDController(rtol=self.tolerance, atol=self.tolerance),
            max_steps=self.max_steps,
            saveat=diffrax.SaveAt(t1=True),
            throw=False,
        )
        assert solution.ys is not None
        return solution.ys[0], RESULTS.promote(solution.result)


def _move(x: Lanes, h: Any, k: Lanes) -> Lanes:
    return tuple(a + h * b for a, b in zip(x, k, strict=True))


def _stack(entries: list[Lanes]) -> Lanes:
    return tuple(jnp.stack(component) for component in zip(*entries, strict=True))


def stacked(rate: Callable[[Any, Array, Any], Array]) -> Rate:
    """A user's rate of stacked states, for states held as tuples: stacked only here."""

    def call(t: Any, x: Lanes, u: Lanes) -> Lanes:
        return lanes(rate(t, jnp.stack(x), jnp.stack(u)))

    # Recomputed in reverse mode: storing every intermediate of every stage costs more.
    return jax.checkpoint(call, prevent_cse=False)  # pyright: ignore
