"""Integrators: how a flight is flown from one sample to the next."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.laws.lanes import Lanes, lanes
from jaxguide.laws.law import Command
from jaxguide.nominal.steps import adaptive
from jaxguide.types import RESULTS

Rate = Callable[[Any, Any, Any], Any]  # (t, x, u) -> dx/dt


class Integrator(eqx.Module):
    """Abstract: flies the vehicle across one sample.

    A pytree; whatever fixes its amount of work (steps, orders) is a static field. It must work
    under `jit`, `vmap` and `grad`, and never raises for the value of a number.
    """

    @abc.abstractmethod
    def across(
        self, rate: Rate, flown: Command, t: Any, t_next: Any, x: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], RESULTS]:
        """The state at the next sample.

        **Arguments:** `rate(t, x, u)` -> (n,): dx/dt of the plant with its disturbances, for a time
        (), a state (n,) and a control (m,); `flown`: `flown(s)` is the control (m,) at any time s
        from `t` to `t_next`; `t`, `t_next` (): the sample's beginning and end, which may be one and
        the same (the state is then `x`); `x` (n,): state at `t`.

        **Returns:** the state (n,) at `t_next`, in the dtype of `x`, and `jg.RESULTS.successful` or
        another result. Then, or where the state is not finite, the flight is `diverged`, its state
        held at the last finite one.
        """


class StagedIntegrator(Integrator):
    """Abstract: an integrator with fixed stages, for the fast path (see `jaxguide.laws.lanes`)."""

    @property
    @abc.abstractmethod
    def stages(self) -> tuple[float, ...]:
        """The fractions of the sample at which the control is asked for, from 0 to 1."""

    @abc.abstractmethod
    def across_stages(
        self,
        rate: Rate,
        t: Any,
        width: Any,
        x: Lanes,
        nominal: tuple[Lanes, ...],
        deviation: tuple[Lanes, ...],
    ) -> Lanes:
        """The state after a sample of length `width`, of which the nominal and the deviation of the
        control are given at `stages`; one deviation alone is constant over the sample. `rate` takes
        and returns Lanes."""


class RungeKutta4(StagedIntegrator):
    """The classical fourth-order method, `steps` equal steps a sample; fast in batches.

    **Error:** of fourth order in the sample interval over `steps`.

    **Raises:** `ValueError` for less than one step.
    """

    steps: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        if self.steps < 1:
            raise ValueError(f"RungeKutta4: steps is {self.steps}; give at least 1.")

    @property
    def stages(self) -> tuple[float, ...]:
        return tuple(i / (2 * self.steps) for i in range(2 * self.steps + 1))

    def across(
        self, rate: Rate, flown: Command, t: Any, t_next: Any, x: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], RESULTS]:
        t, t_next = jnp.asarray(t, x.dtype), jnp.asarray(t_next, x.dtype)
        controls = jax.vmap(flown)(t + (t_next - t) * jnp.asarray(self.stages, x.dtype))
        asked = tuple(lanes(controls[j]) for j in range(len(self.stages)))
        none = (tuple(jnp.zeros_like(u) for u in asked[0]),)
        final = self.across_stages(stacked(rate), t, t_next - t, lanes(x), asked, none)
        return jnp.stack(final), RESULTS.successful

    def across_stages(
        self,
        rate: Rate,
        t: Any,
        width: Any,
        x: Lanes,
        nominal: tuple[Lanes, ...],
        deviation: tuple[Lanes, ...],
    ) -> Lanes:
        # The four stages are a scan: XLA's CPU backend recomputes shared work in every output of a
        # fused loop, and a loop carry is the one cut it respects (unrolled, this is ten times
        # slower). Each sum adds the slope of the turn before, which is at hand.
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
    """Diffrax's Dopri8 to a tolerance: for reference flights, one at a time.

    **Arguments:** `tolerance`: relative and absolute, of each step's error in the state;
    `max_steps` a sample.

    **Error:** of the order of `tolerance`.

    **Raises:** `ValueError` for a tolerance outside (0, 1) or less than one step.
    """

    tolerance: float = eqx.field(static=True, default=1e-11)
    max_steps: int = eqx.field(static=True, default=1024)

    def __check_init__(self):
        if not 0 < self.tolerance < 1:
            raise ValueError(f"Adaptive: tolerance is {self.tolerance}; give one in (0, 1).")
        if self.max_steps < 1:
            raise ValueError(f"Adaptive: max_steps is {self.max_steps}; give at least 1.")

    def across(
        self, rate: Rate, flown: Command, t: Any, t_next: Any, x: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], RESULTS]:
        import diffrax  # only here: see nominal/steps.py

        # Diffrax takes no interval without length: one of length 1 is flown instead, and not used.
        empty = t_next == t
        until = t + jnp.where(empty, 1.0, t_next - t)
        held = lambda t, x: rate(t, x, flown(t))
        solution = adaptive(held, x, t, until, self.tolerance, self.max_steps)
        theirs = diffrax.RESULTS
        result = RESULTS.where(
            solution.result == theirs.max_steps_reached,
            RESULTS.steps_exhausted,
            RESULTS.integration_failed,
        )
        fine = empty | (solution.result == theirs.successful)
        result = RESULTS.where(fine, RESULTS.successful, result)
        return jnp.where(empty, x, solution.ys[0]), result


def _move(x: Lanes, h: Any, k: Lanes) -> Lanes:
    return tuple(a + h * b for a, b in zip(x, k, strict=True))


def _stack(entries: list[Lanes]) -> Lanes:
    return tuple(jnp.stack(component) for component in zip(*entries, strict=True))


def stacked(rate: Rate) -> Rate:
    """A rate of arrays as a rate of Lanes: stacked only where the user's function is called."""

    def call(t: Any, x: Lanes, u: Lanes) -> Lanes:
        return lanes(rate(t, jnp.stack(x), jnp.stack(u)))

    # Recomputed in reverse mode: storing every intermediate of every stage costs more.
    return jax.checkpoint(call, prevent_cse=False)  # pyright: ignore
