"""How a flight is integrated across one sample."""

import abc
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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
        x: tuple[Array, ...],
        controls: Float[Array, "stage m"],
    ) -> tuple[Array, ...]:
        """State after the sample. States are tuples of scalars, so that under `vmap` each is one
        contiguous array of lanes; barriers keep XLA from recomputing a stage inside the next."""
        h = width / self.steps
        for i in range(self.steps):
            a, b, c = controls[2 * i], controls[2 * i + 1], controls[2 * i + 2]
            s = t + i * h
            k1 = barrier(rate(s, x, a))
            k2 = barrier(rate(s + h / 2, _move(x, h / 2, k1), b))
            k3 = barrier(rate(s + h / 2, _move(x, h / 2, k2), b))
            k4 = barrier(rate(s + h, _move(x, h, k3), c))
            x = tuple(
                y + h / 6 * (p + 2 * (q + r) + s_)
                for y, p, q, r, s_ in zip(x, k1, k2, k3, k4, strict=True)
            )
        return x


class Adaptive(Integrator):
    """Diffrax's Dopri8 to a tolerance: reference flights, one at a time."""

    tolerance: float = eqx.field(static=True, default=1e-11)
    max_steps: int = eqx.field(static=True, default=1024)

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


def _move(x: tuple[Array, ...], h: Any, k: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(a + h * b for a, b in zip(x, k, strict=True))


@jax.custom_jvp
def barrier(values: Any) -> Any:
    """The values themselves, which XLA must hold before it goes on; transparent to derivatives."""
    return jax.lax.optimization_barrier(values)


@barrier.defjvp
def _barrier_jvp(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    return barrier(primals[0]), tangents[0]


def stacked(rate: Callable[[Any, Array, Any], Array]) -> Rate:
    """A user's rate of stacked states, for states held as tuples: stacked only here."""

    def call(t: Any, x: tuple[Array, ...], u: Any) -> tuple[Array, ...]:
        dx = rate(t, jnp.stack(x), u)
        return tuple(dx[i] for i in range(len(x)))

    return call
