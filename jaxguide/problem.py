"""Problem P of Ross & Karpenko (2012), eq. (2), stated by the user as an `equinox.Module`."""

import abc
import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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
Path = tuple[str | int, ...]  # attributes and indices that lead from a Problem to a leaf


def with_parameters(problem: Problem, p: Any) -> Problem:
    """`problem` with the numbers `p` (None: where a search starts) for its `Free` parameters."""
    paths = problem.parameter_paths()
    if not paths:
        return problem  # itself, and not a copy
    entries = parameters(problem)
    if p is None:
        p = [as_float(start_value(entry)) for entry in entries]
    where = lambda q: [_follow(q, path) for path in paths]
    return eqx.tree_at(where, problem, [p[i] for i in range(len(paths))], is_leaf=is_free)


def parameters(problem: Problem, like: Problem | None = None) -> list[Any]:
    """The entries of `problem` at its (or `like`'s) parameter paths."""
    return [
        _follow(problem, path) for path in (problem if like is None else like).parameter_paths()
    ]


def _follow(tree: Any, path: Path) -> Any:
    for key in path:
        tree = getattr(tree, key) if isinstance(key, str) else tree[key]
    return tree


class Chosen(eqx.Module):
    """Static parameters that a solver chose: where a Problem holds them, and their bounds."""

    paths: tuple[Path, ...] = eqx.field(static=True)
    bounds: tuple[Array, Array]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(".".join(map(str, path)) for path in self.paths)

    def values(self, problem: Problem) -> Float[Array, " k"]:
        return jnp.stack([as_float(_follow(problem, path)) for path in self.paths])

    def into(self, problem: Problem, p: Array) -> Problem:
        """`problem` with the numbers `p` for them."""
        where = lambda q: [_follow(q, path) for path in self.paths]
        return eqx.tree_at(where, problem, [p[i] for i in range(len(self.paths))])


def choices(problem: Problem) -> Chosen | None:
    """The `Free` parameters of `problem`; None where there are none."""
    entries = parameters(problem)
    if not entries:
        return None
    side = lambda k: jnp.stack([as_float(getattr(e, k)) for e in entries])
    return Chosen(problem.parameter_paths(), (side("lo"), side("hi")))


def replace_parameters(problem: Problem, names: tuple[str, ...], values: Any) -> Problem:
    """`problem` with scalar fields `names` set to the entries of `values`."""
    return dataclasses.replace(problem, **{name: values[i] for i, name in enumerate(names)})


def with_array_leaves(problem: Problem) -> Problem:
    """The same problem with every leaf an array, so that it passes through `jax.jit`."""
    return jax.tree_util.tree_map(jnp.asarray, problem)


@jax.jit
def hamiltonian(
    problem: Problem, t: Any, x: Float[Array, " n"], u: Float[Array, " m"], costate: Array
) -> Float[Array, ""]:
    """H = F + lambda^T f (paper eq. 4 with the running cost added)."""
    return problem.running_cost(t, x, u) + jnp.dot(costate, problem.dynamics(t, x, u))


def initially_free(problem: Problem) -> tuple[bool, ...]:
    """Which components of the initial state are free."""
    entries = problem.initial_state
    if isinstance(entries, (tuple, list)):
        return tuple(is_free(e) for e in entries)
    return (entries is None or is_free(entries),) * problem.n


def initial_entries(problem: Problem) -> tuple[Any, ...]:
    """One entry a state: a number or `Free`."""
    start = problem.initial_state
    if isinstance(start, (tuple, list)):
        return tuple(start)
    if start is None or is_free(start):
        return (Free() if start is None else start,) * problem.n
    return tuple(start[i] for i in range(problem.n))


def initial_values(problem: Problem, dtype: Any) -> Float[Array, " n"]:
    """Initial state, free components at their guess (or 0)."""
    entries = problem.initial_state
    if entries is None:
        return jnp.zeros(problem.n, dtype)
    if isinstance(entries, (tuple, list)):
        return jnp.stack([jnp.asarray(start_value(e), dtype) for e in entries])
    return jnp.broadcast_to(jnp.asarray(start_value(entries), dtype), (problem.n,))


def start_value(entry: Any) -> Any:
    """A number, or the point from which a `Free` one is sought: guess, middle, or nearest to 0."""
    if not is_free(entry):
        return entry
    if entry.guess is not None:
        return entry.guess
    lo, hi = as_float(entry.lo), as_float(entry.hi)
    middle = jnp.where(jnp.isfinite(lo) & jnp.isfinite(hi), (lo + hi) / 2, jnp.clip(0.0, lo, hi))
    return middle


def bounds_of(bounds: Any, size: int, dtype: Any) -> tuple[Array, Array]:
    """`(lower, upper)` broadcast to `(size,)` each."""
    lower, upper = bounds
    return (
        jnp.broadcast_to(jnp.asarray(lower, dtype), (size,)),
        jnp.broadcast_to(jnp.asarray(upper, dtype), (size,)),
    )


def initial_bounds(problem: Problem) -> tuple[Array, Array]:
    """Of the initial state, where it is free: its own and those of every state."""
    lo, hi = bounds_of(problem.state_bounds, problem.n, jnp.result_type(float))
    entries = [e if is_free(e) else Free() for e in initial_entries(problem)]
    own = [jnp.stack([jnp.asarray(getattr(e, k), lo.dtype) for e in entries]) for k in ("lo", "hi")]
    return jnp.maximum(lo, own[0]), jnp.minimum(hi, own[1])


def count(problem: Problem, name: str) -> int:
    """Components of its path constraints or integrands."""
    dtype = jnp.result_type(float)
    t, x, u = (jax.ShapeDtypeStruct(s, dtype) for s in ((), (problem.n,), (problem.m,)))
    return jax.eval_shape(getattr(with_parameters(problem, None), name), t, x, u).shape[0]


def endpoint_count(problem: Problem) -> int:
    """Components of its endpoint constraints."""
    dtype = jnp.result_type(float)
    t, x = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct((problem.n,), dtype)
    problem = with_parameters(problem, None)
    return jax.eval_shape(problem.endpoint_constraints, x, x, t, t).shape[0]


def start_control(problem: Problem, dtype: Any) -> Float[Array, " m"]:
    """A control to start Newton from: the middle of finite bounds, else near 0.

    The slight offset keeps clear of points where H_u = 0 by symmetry (a maximum, say).
    """
    lo, hi = bounds_of(problem.control_bounds, problem.m, dtype)
    finite = jnp.isfinite(lo) & jnp.isfinite(hi)
    middle = jnp.where(finite, (lo + hi) / 2, jnp.clip(jnp.zeros_like(lo), lo, hi))
    return middle + 0.1 * jnp.where(finite, (hi - lo) / 2, 1.0)


@jax.jit
def _start(problem: Problem) -> tuple[Array, ...]:
    """Times, state, control and rate from which a search would start."""
    dtype = jnp.result_type(float)
    times = (problem.initial_time, problem.final_time)
    t0, tf = (jnp.asarray(start_value(t), dtype) for t in times)
    x0, u0 = initial_values(problem, dtype), start_control(problem, dtype)
    return t0, tf, x0, u0, with_parameters(problem, None).dynamics(t0, x0, u0)


def _shape(problem: Problem, name: str, wanted: tuple[int, ...] | None, *args: Any) -> tuple:
    try:
        out = jax.eval_shape(getattr(with_parameters(problem, None), name), *args)
    except Exception as e:
        raise ValueError(
            f"{type(problem).__name__}.{name} could not be evaluated with a state of "
            f"{problem.n} and a control of {problem.m} components: {e}"
        ) from e
    shape = getattr(out, "shape", None)
    if wanted is not None and shape != wanted:
        raise ValueError(
            f"{type(problem).__name__}.{name} returned shape {shape}, expected {wanted}. "
            + ("Return a scalar." if wanted == () else "Stack one entry per state.")
        )
    if wanted is None and (shape is None or len(shape) != 1):
        raise ValueError(
            f"{type(problem).__name__}.{name} returned shape {shape}; return a vector (jnp.stack)."
        )
    return shape  # pyright: ignore[reportReturnType]


def _check_names(problem: Problem, name: str) -> None:
    names = getattr(problem, name)
    if isinstance(names, str) or not isinstance(names, tuple) or not names:
        raise ValueError(
            f"{type(problem).__name__}.{name} is {names!r}; give a non-empty tuple of strings, "
            f"such as {name} = ('x',)."
        )
    if len(set(names)) != len(names):
        raise ValueError(f"{type(problem).__name__}.{name} repeats a name: {names}.")


def _check_bounds(problem: Problem, name: str, size: int) -> None:
    bounds = getattr(problem, name)
    if not isinstance(bounds, tuple) or len(bounds) != 2:
        raise ValueError(f"{type(problem).__name__}.{name} is {bounds!r}; give (lower, upper).")
    try:
        lower, upper = (np.broadcast_to(np.asarray(b, float), (size,)) for b in bounds)
    except ValueError as e:
        raise ValueError(
            f"{type(problem).__name__}.{name} = {bounds} does not broadcast to {size} components."
        ) from e
    bad = ~(lower <= upper)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"{type(problem).__name__}.{name}: component {i} has lower {lower[i]} above upper "
            f"{upper[i]} (or NaN); exchange or repair them."
        )


def _check_start(problem: Problem, x0: Any) -> None:
    """Refuses an initial state, or a range of one, outside the state bounds."""
    lower, upper = (
        np.broadcast_to(np.asarray(b, float), (problem.n,)) for b in problem.state_bounds
    )
    for i, (name, entry) in enumerate(
        zip(problem.state_names, initial_entries(problem), strict=True)
    ):
        free = is_free(entry)
        lo, hi = (float(entry.lo), float(entry.hi)) if free else (float(x0[i]), float(x0[i]))
        slack = 1e-9 * (1 + abs(x0[i]))
        if hi < lower[i] - slack or lo > upper[i] + slack:
            given = f"between {lo} and {hi}" if free else f"{lo}"
            raise ValueError(
                f"{type(problem).__name__}.initial_state: {name} is {given}, outside state_bounds "
                f"[{lower[i]}, {upper[i]}]; mend one of the two."
            )


def check_initial_state(problem: Problem) -> None:
    """Refuses initial entries that are not one a state."""
    kind, n = type(problem).__name__, problem.n
    entries = problem.initial_state
    if entries is not None and not is_free(entries):
        if not isinstance(entries, (tuple, list)) and jnp.ndim(entries) != 1:
            raise ValueError(
                f"{kind}.initial_state is {entries!r}; give one entry for each of the {n} states "
                f"{problem.state_names}."
            )
        size = len(entries) if isinstance(entries, (tuple, list)) else jnp.shape(entries)[0]
        if size != n:
            raise ValueError(
                f"{kind}.initial_state has {size} entries for {n} states {problem.state_names}."
            )


def validate(problem: Problem) -> None:
    """Refuses a badly stated problem, naming the field, its value and the remedy.

    Shapes are always checked; values only when they are concrete (not under a trace).

    **Raises:** `ValueError`.
    """
    if not isinstance(problem, Problem):
        raise ValueError(
            f"expected an instance of a jaxguide.Problem, got {problem!r}; "
            "did you pass the class and not an instance?"
        )
    kind = type(problem).__name__
    _check_names(problem, "state_names")
    _check_names(problem, "control_names")
    problem.check_statement()
    n, m = problem.n, problem.m
    dtype = jnp.result_type(float)
    check_initial_state(problem)
    t = jax.ShapeDtypeStruct((), dtype)
    x, u = jax.ShapeDtypeStruct((n,), dtype), jax.ShapeDtypeStruct((m,), dtype)
    _shape(problem, "dynamics", (n,), t, x, u)
    _shape(problem, "running_cost", (), t, x, u)
    _shape(problem, "endpoint_cost", (), x, x, t, t)
    q = _shape(problem, "endpoint_constraints", None, x, x, t, t)[0]
    p = _shape(problem, "path_constraints", None, t, x, u)[0]
    r = _shape(problem, "integrands", None, t, x, u)[0]
    if problem.has_closed_form:
        _shape(problem, "optimal_control", (m,), t, x, x)
    if is_traced(problem):
        return
    for name, size in (
        ("state_bounds", n),
        ("control_bounds", m),
        ("endpoint_bounds", q),
        ("path_bounds", p),
        ("integral_bounds", r),
    ):
        _check_bounds(problem, name, size)
    with jax.ensure_compile_time_eval():  # within a trace of something else, perhaps
        t0, tf, x0, u0, rate = jax.device_get(_start(with_array_leaves(problem)))
    free = initially_free(problem)
    for i, name in enumerate(problem.state_names):
        if not np.isfinite(x0[i]):
            raise ValueError(
                f"{kind}.initial_state: {name} is {x0[i]}; give a finite number"
                + (" as the guess of its jg.Free." if free[i] else " or jg.Free().")
            )
    _check_start(problem, x0)
    t0, tf = float(t0), float(tf)
    if math.isnan(t0) or math.isnan(tf) or math.isinf(t0):
        raise ValueError(f"{kind}: initial_time is {t0} and final_time is {tf}; give numbers.")
    if math.isinf(tf) and is_free(problem.initial_time):
        raise ValueError(
            f"{kind}: final_time is infinite and initial_time is {problem.initial_time}; give a "
            "number for one of the two."
        )
    if not tf > t0 and not is_free(problem.final_time) and not is_free(problem.initial_time):
        raise ValueError(
            f"{kind}: final_time {tf} is not after initial_time {t0}; the horizon must be positive."
        )
    latest = problem.final_time.hi if is_free(problem.final_time) else tf
    earliest = problem.initial_time.lo if is_free(problem.initial_time) else t0
    if not float(latest) > float(earliest):
        raise ValueError(
            f"{kind}: final_time is at most {float(latest)} and initial_time at least "
            f"{float(earliest)}; the horizon must be positive."
        )
    if not np.all(np.isfinite(rate)) and not any(free):
        i = int(np.argmin(np.isfinite(rate)))
        raise ValueError(
            f"{kind}.dynamics: d({problem.state_names[i]})/dt is {rate[i]} at the start "
            f"t={t0}, x={x0}, u={u0}; state bounds or a guess that keep "
            "clear of the singularity, or mend the equation."
        )
