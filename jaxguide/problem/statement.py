"""Problem P of Ross & Karpenko (2012), eq. (2), stated by the user as an `equinox.Module`."""

import abc
import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.types import as_float, is_traced


class Free(eqx.Module):
    """A number the solver may choose, within `[lo, hi]`, starting from `guess` if given.

    Used for the initial or final time, a component of the initial state, or a static parameter.
    """

    lo: Any = -math.inf
    hi: Any = math.inf
    guess: Any = None

    def __check_init__(self):
        if not is_traced((self.lo, self.hi)) and not np.all(np.asarray(self.lo) <= self.hi):
            raise ValueError(f"Free: lo={self.lo} lies above hi={self.hi}; exchange them.")


def is_free(x: object) -> bool:
    return isinstance(x, Free)


class Problem(eqx.Module):
    r"""An optimal control problem: minimise
    $E(x_0, x_f, t_0, t_f) + \int F(t, x, u)\,dt$ subject to $\dot x = f(t, x, u)$,
    endpoint constraints $e$ and path constraints $h$ within bounds.

    Subclass it, name the states and controls, and write `dynamics`. Parameters are fields; a plant
    with another thrust is `dataclasses.replace(problem, thrust=...)`. Boundary data may be written
    as plain class attributes: they become instance leaves (see `__init_subclass__`).

    **Source:** review, eq. (2); H = F + lambda^T f is minimised.
    """

    state_names: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    control_names: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    initial_time: Any = eqx.field(default=0.0, kw_only=True)
    final_time: Any = eqx.field(default=1.0, kw_only=True)
    initial_state: Any = eqx.field(default=None, kw_only=True)
    state_bounds: Any = eqx.field(default=(-math.inf, math.inf), kw_only=True)
    control_bounds: Any = eqx.field(default=(-math.inf, math.inf), kw_only=True)
    endpoint_bounds: Any = eqx.field(default=(0.0, 0.0), kw_only=True)
    path_bounds: Any = eqx.field(default=(-math.inf, 0.0), kw_only=True)
    integral_bounds: Any = eqx.field(default=(-math.inf, math.inf), kw_only=True)

    def __init_subclass__(cls, **kwargs: Any):
        # Dataclasses ignore an override without annotation, and the base's default would silently
        # win. Every plain attribute that names an inherited field becomes that field, keyword-only
        # so that a subclass may still add fields without defaults.
        super().__init_subclass__(**kwargs)
        annotations = dict(cls.__dict__.get("__annotations__", {}))
        inherited = {
            f.name: f
            for base in reversed(cls.__mro__[1:])
            for f in getattr(base, "__dataclass_fields__", {}).values()
        }
        for name, base in inherited.items():
            if name not in cls.__dict__ or name in annotations:
                continue
            value = cls.__dict__[name]
            if isinstance(value, (property, dataclasses.Field)) or callable(value):
                continue
            annotations[name] = base.type
            options: dict[str, Any] = {"kw_only": base.kw_only}
            if base.metadata.get("static", False):
                options["static"] = True
            if (
                type(value).__hash__ is None
            ):  # arrays and lists: dataclasses refuses them as default
                setattr(cls, name, eqx.field(default_factory=lambda v=value: v, **options))
            else:
                setattr(cls, name, eqx.field(default=value, **options))
        cls.__annotations__ = annotations

    @abc.abstractmethod
    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        """dx/dt, shape (n,)."""

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        """F, scalar."""
        return jnp.zeros((), x.dtype)

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        """E, scalar, minimised."""
        return jnp.zeros((), xf.dtype)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        """e, shape (q,), kept within `endpoint_bounds` (default e = 0)."""
        return jnp.zeros((0,), xf.dtype)

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        """h, shape (p,), kept within `path_bounds` (default h <= 0)."""
        return jnp.zeros((0,), x.dtype)

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        """Integrands, shape (r,), whose integrals are kept within `integral_bounds`."""
        return jnp.zeros((0,), x.dtype)

    def optimal_control(self, t: Any, x: Any, costate: Any) -> Any:
        """Optional closed form of H_u = 0 with H minimised, shape (m,); None: solved by Newton."""
        return None

    def check_statement(self) -> None:
        """Refuses, with a `ValueError`, what a kind of Problem knows to be badly stated."""

    def parameter_paths(self) -> tuple[tuple[str | int, ...], ...]:
        """Where a `Free` static parameter is held, for the solver to choose."""
        return tuple(
            (f.name,)
            for f in dataclasses.fields(self)
            if f.name not in _BOUNDARY and is_free(getattr(self, f.name))
        )

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @property
    def m(self) -> int:
        """Number of controls."""
        return len(self.control_names)

    @property
    def has_closed_form(self) -> bool:
        """Whether the subclass offers `optimal_control`."""
        return type(self).optimal_control is not Problem.optimal_control


_BOUNDARY = ("initial_time", "final_time", "initial_state")


def with_array_leaves(problem: Problem) -> Problem:
    """The same problem with every leaf an array, so that it passes through `jax.jit`."""
    return jax.tree_util.tree_map(jnp.asarray, problem)


def start_value(entry: Any) -> Any:
    """A number, or the point from which a `Free` one is sought: guess, middle, or nearest to 0."""
    if not is_free(entry):
        return entry
    if entry.guess is not None:
        return entry.guess
    lo, hi = as_float(entry.lo), as_float(entry.hi)
    middle = jnp.where(jnp.isfinite(lo) & jnp.isfinite(hi), (lo + hi) / 2, jnp.clip(0.0, lo, hi))
    return middle
