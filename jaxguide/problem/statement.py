"""Problem P of Ross & Karpenko (2012), eq. (2), stated by the user as an `equinox.Module`."""

import abc
import dataclasses
import inspect
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.arrays import xp
from jaxguide.types import is_traced


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
    """Whether `x` is for the solver to choose."""
    return isinstance(x, Free)


class Problem(eqx.Module):
    r"""An optimal control problem: minimise
    $E(x_0, x_f, t_0, t_f) + \int F(t, x, u)\,dt$ subject to $\dot x = f(t, x, u)$,
    endpoint constraints $e$ and path constraints $h$ within bounds.

    Subclass it, name the states and controls, and write `dynamics`. Parameters are fields; a plant
    with another thrust is `dataclasses.replace(problem, thrust=...)`.

    A Problem without `control_names` has no control, and `u` no entries: initial states and static
    parameters (fields that hold a `jg.Free`) are then all there is to choose, as in identification.
    Ends that should be alike, as on a periodic orbit, are endpoint constraints, `xf - x0`, on an
    `initial_state` that is `jg.Free()`. `jg.Phased` joins Problems, and says which fields they
    share.

    Boundary data (times, initial state, bounds, names) may be written

    - as plain class attributes, `final_time = 2.0`: they become fields, which `replace`,
      `equinox.tree_at`, `jax.grad` and `jax.vmap` reach;
    - as a property, where they follow from other fields:

          class Toss(jg.Problem):
              speed: float = 10.0

              @property
              def initial_state(self):
                  return (0.0, self.speed)

      A property is no field: it has no leaf and cannot be replaced. Replace the fields that it is
      computed from; derivatives by them go through the property.

    **Raises:** `TypeError` for a plain array or list over a property of the base class: write a
    tuple, or a property.

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
        # win. Here every plain attribute that names an inherited field becomes that field, and a
        # property in a field's place is annotated as a ClassVar: dataclasses leave those out.
        super().__init_subclass__(**kwargs)
        annotations = dict(cls.__dict__.get("__annotations__", {}))
        inherited = {
            f.name: f
            for base in reversed(cls.__mro__[1:])
            if dataclasses.is_dataclass(base)
            for f in dataclasses.fields(base)
        }
        for name, field in inherited.items():
            value = inspect.getattr_static(cls, name, None)
            if isinstance(value, property):
                annotations[name] = ClassVar
            elif name in cls.__dict__ and name not in annotations:
                if not isinstance(value, dataclasses.Field) and not callable(value):
                    annotations[name] = field.type
                    setattr(cls, name, _restated(cls, field, value))
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
        """For kinds of Problems with rules of their own: raises `ValueError` if one is broken."""

    def parameter_paths(self) -> tuple[tuple[str | int, ...], ...]:
        """Attributes and indices that lead to each `Free` static parameter."""
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


def _restated(cls: type, field: dataclasses.Field, value: Any) -> Any:
    """The inherited `field` with `value` as its default in `cls`; keyword-only where it was, so
    that `cls` may still add fields without defaults."""
    options: dict[str, Any] = {"kw_only": field.kw_only}
    if field.metadata.get("static", False):
        options["static"] = True
    if type(value).__hash__ is not None:
        return eqx.field(default=value, **options)
    # Arrays and lists: dataclasses takes them from a factory only, and leaves no attribute of the
    # class, so that a property of a base class would be in the way.
    for base in cls.__mro__[1:]:
        if isinstance(base.__dict__.get(field.name), property):
            raise TypeError(
                f"{cls.__name__}.{field.name} is a {type(value).__name__}, but a property of "
                f"{base.__name__}; write a tuple, or a property as well."
            )
    return eqx.field(default_factory=lambda: value, **options)


_BOUNDARY = ("initial_time", "final_time", "initial_state")


def with_array_leaves(problem: Problem) -> Problem:
    """The same problem with every leaf an array, so that it passes through `jax.jit`."""
    return jax.tree_util.tree_map(jnp.asarray, problem)


def with_typed_leaves(problem: Problem) -> Problem:
    """`with_array_leaves` whose floating numbers are of the default type, which compiles nothing;
    those that are traced stay so."""
    dtype = jnp.result_type(float)
    typed = lambda a: np.asarray(a, dtype) if isinstance(a, float) else jnp.asarray(a)
    return jax.tree_util.tree_map(typed, problem)


def start_value(entry: Any) -> Any:
    """`entry` if it is a number. Of a `Free` one the point from which a search starts: its guess,
    otherwise the middle of finite limits, otherwise the admissible number closest to 0."""
    if not is_free(entry):
        return entry
    if entry.guess is not None:
        return entry.guess
    lo, hi = (xp.asarray(v, jnp.result_type(float)) for v in (entry.lo, entry.hi))
    bounded, nearest = xp.isfinite(lo) & xp.isfinite(hi), xp.clip(xp.zeros_like(lo), lo, hi)
    low, high = (xp.where(bounded, side, 0.0) for side in (lo, hi))
    return xp.where(bounded, (low + high) / 2, nearest)
