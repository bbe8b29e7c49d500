"""`jg.Phased`: Problems that follow each other in time, as one Problem."""

import dataclasses
import inspect
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.bounds import bounds_of
from jaxguide.problem import (
    Free,
    Problem,
    check_initial_state,
    count,
    endpoint_count,
    initial_entries,
    is_free,
    start_value,
)
from jaxguide.trajectory import Extremal, Multipliers
from jaxguide.transforms.wrapped import Wrapped, own_fields, restated
from jaxguide.types import is_traced

_BOUNDARY = {field.name for field in dataclasses.fields(Problem)}

Kind = TypeVar("Kind", bound=Extremal)  # with its certificate, or without


class PhaseEnds(NamedTuple):
    """State and time at both ends of one phase, as `links` sees them."""

    x0: Float[Array, " n"]
    xf: Float[Array, " n"]
    t0: Float[Array, ""]
    tf: Float[Array, ""]


class Linked(Wrapped):
    """A phase whose final state is given: that at which the next phase starts."""

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf


class Phased(Problem):
    """Phases that follow each other in time, each with dynamics, bounds, costs and constraints of
    its own: staging, a rocket's arcs, anything with a jump of the state.

    All phases run side by side on tau in [0, 1], t = t0 + tau (tf - t0) in each, so this is a
    Problem like any other: review, eq. (2) and section 4 on knots.

    **Arguments:** `phases`: Problems; each starts when the one before ends, at its `final_time` (a
    number or `jg.Free`), and only the first one's `initial_time` counts. A later phase's
    `initial_state` may be None: the links then give it. `links(ends)`: (r,) numbers that must
    vanish, from a `PhaseEnds` for each phase; default: the state is continuous. A function, or an
    `equinox.Module`, whose leaves (such as the size of a jump) are then differentiable. `shared`:
    names of fields, such as a static parameter, that are one and the same in all phases that have
    them: the first one's counts.

    Names, times, bounds and initial entries are properties that follow from the phases: edit the
    phases, by `equinox.tree_at` or with new ones.

    **Raises:** `ValueError` if phases that should be continuous have other states, times do not
    ascend, or a phase has no end.
    """

    phases: tuple[Problem, ...]
    links: Any
    shared: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, phases: Any, links: Any = None, shared: tuple[str, ...] = ()):
        self.phases, self.shared = tuple(phases), tuple(shared)
        plain = links is not None and not isinstance(links, (eqx.Module, jax.tree_util.Partial))
        self.links = jax.tree_util.Partial(links) if plain else links
        self.check_statement()

    def check_statement(self) -> None:
        """Refuses phases that cannot follow each other; `solve` asks as well.

        **Raises:** `ValueError`.
        """
        phases, links = self.phases, self.links
        if len(phases) < 2:
            raise ValueError(f"Phased: {len(phases)} phases; give at least two.")
        for name in self.shared:
            if name in _BOUNDARY or sum(hasattr(phase, name) for phase in phases) < 2:
                raise ValueError(
                    f"Phased: shared has {name!r}; name a field of your own that two phases have."
                )
        for i, phase in enumerate(phases):
            check_initial_state(phase)
            tf = phase.final_time
            if not is_free(tf) and not is_traced(tf) and np.any(np.isinf(np.asarray(tf))):
                raise ValueError(
                    f"Phased: {type(phase).__name__}.final_time is infinite; give an end."
                )
            a, b = self.horizons()[i]
            earliest, latest = a.lo if is_free(a) else a, b.hi if is_free(b) else b
            if not is_traced((earliest, latest)) and not float(latest) > float(earliest):
                raise ValueError(
                    f"Phased: phase {i + 1}, {type(phase).__name__}, starts at {_as_text(a)} and "
                    f"ends at {_as_text(b)}; times must ascend. A phase starts at the final_time "
                    "of the one before."
                )
        for a, b in zip(phases[:-1], phases[1:], strict=True):
            if links is None and a.state_names != b.state_names:
                raise ValueError(
                    f"Phased: {type(a).__name__} has states {a.state_names} and "
                    f"{type(b).__name__} has {b.state_names}; say in `links` how they join."
                )
        function = getattr(links, "func", None)
        if inspect.isfunction(function) and is_traced(
            list(inspect.getclosurevars(function).nonlocals.values())
        ):
            raise ValueError(
                f"Phased: links {function.__name__!r} closes over a traced number. Make it a field "
                "of an equinox.Module with __call__(self, ends), and give that as `links`."
            )

    def _named(self, of: Callable[[Problem], tuple[str, ...]]) -> tuple[str, ...]:
        return tuple(f"{i + 1}:{k}" for i, p in enumerate(self.phases) for k in of(p))

    def _joined(self, name: str, sizes: list[int]) -> tuple[Array, Array]:
        """Bounds `name` of all phases."""
        each = zip(self.phases, sizes, strict=True)
        dtype = jnp.result_type(float)
        return _join([bounds_of(getattr(p, name), n, dtype) for p, n in each])

    @property
    def state_names(self) -> tuple[str, ...]:
        return self._named(lambda p: p.state_names)

    @property
    def control_names(self) -> tuple[str, ...]:
        return self._named(lambda p: p.control_names)

    # Without the names: they are long, and the numbers are asked for often.
    @property
    def n(self) -> int:
        return sum(p.n for p in self.phases)

    @property
    def m(self) -> int:
        return sum(p.m for p in self.phases)

    @property
    def initial_time(self) -> float:
        return 0.0

    @property
    def final_time(self) -> float:
        return 1.0

    @property
    def initial_state(self) -> tuple[Any, ...]:
        """One entry a state, phase after phase."""
        return _starts(self.phases)

    @property
    def state_bounds(self) -> tuple[Array, Array]:
        return self._joined("state_bounds", [p.n for p in self.phases])

    @property
    def control_bounds(self) -> tuple[Array, Array]:
        return self._joined("control_bounds", [p.m for p in self.phases])

    @property
    def path_bounds(self) -> tuple[Array, Array]:
        return self._joined("path_bounds", [count(p, "path_constraints") for p in self.phases])

    @property
    def integral_bounds(self) -> tuple[Array, Array]:
        return self._joined("integral_bounds", [count(p, "integrands") for p in self.phases])

    @property
    def endpoint_bounds(self) -> tuple[Array, Array]:
        own = self._joined("endpoint_bounds", [endpoint_count(p) for p in self.phases])
        zero: Any = np.zeros(self._links_count(), own[0].dtype)
        last: Any = np.full(len(self.phases), np.inf, own[0].dtype)
        return _join([own, (zero, zero), (np.zeros_like(last), last)])

    def stated_phases(self) -> tuple[Problem, ...]:
        """The phases, each with the fields that it shares."""
        held: dict[str, Any] = {}
        out = []
        for phase in self.phases:
            for name in self.shared:
                if name in held and hasattr(phase, name):
                    where = operator.attrgetter(name)
                    phase = eqx.tree_at(where, phase, held[name], is_leaf=is_free)
                elif hasattr(phase, name):
                    held[name] = getattr(phase, name)
            out.append(phase)
        return tuple(out)

    def parameter_paths(self) -> tuple[tuple[str | int, ...], ...]:
        paths: list[tuple[str | int, ...]] = []
        seen: set[str] = set()
        for i, phase in enumerate(self.phases):
            names = ("initial_time", "final_time") if i == 0 else ("final_time",)
            paths += [("phases", i, k) for k in names if is_free(getattr(phase, k))]
            own = [path for path in phase.parameter_paths() if path[0] not in seen]
            paths += [("phases", i, *path) for path in own]
            seen |= {name for name in self.shared if hasattr(phase, name)}
        return tuple(paths)

    def horizons(self) -> list[tuple[Any, Any]]:
        """(t0, tf) of each phase, in the phases' unit of time; `Free` where the solver chooses."""
        times = [self.phases[0].initial_time, *(p.final_time for p in self.phases)]
        return list(zip(times[:-1], times[1:], strict=True))

    def split_state(self, x: Array) -> list[Array]:
        """The states of each phase, from the last axis of `x`."""
        return jnp.split(x, np.cumsum([p.n for p in self.phases])[:-1], axis=-1)

    def split_control(self, u: Array) -> list[Array]:
        """The controls of each phase, from the last axis of `u`."""
        return jnp.split(u, np.cumsum([p.m for p in self.phases])[:-1], axis=-1)

    def _each(self, tau: Any, x: Any, u: Any) -> list[tuple]:
        """(phase, duration, t, x, u) of each phase at `tau`."""
        parts = zip(
            self.stated_phases(),
            self.horizons(),
            self.split_state(x),
            self.split_control(u),
            strict=True,
        )
        return [(p, b - a, a + tau * (b - a), x, u) for p, (a, b), x, u in parts]

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.concatenate([span * p.dynamics(*at) for p, span, *at in self._each(t, x, u)])

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        return sum(span * p.running_cost(*at) for p, span, *at in self._each(t, x, u))

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.concatenate([p.path_constraints(*at) for p, _, *at in self._each(t, x, u)])

    def integrands(self, t: Any, x: Any, u: Any) -> Any:
        return jnp.concatenate([span * p.integrands(*at) for p, span, *at in self._each(t, x, u)])

    def _ends(self, x0: Any, xf: Any) -> tuple[PhaseEnds, ...]:
        ends = zip(self.split_state(x0), self.split_state(xf), self.horizons(), strict=True)
        return tuple(PhaseEnds(a, b, *(jnp.asarray(t, x0.dtype) for t in h)) for a, b, h in ends)

    def _links(self, ends: tuple[PhaseEnds, ...]) -> Array:
        if self.links is not None:
            return jnp.atleast_1d(self.links(ends))
        return jnp.concatenate([b.x0 - a.xf for a, b in zip(ends[:-1], ends[1:], strict=True)])

    def _links_count(self) -> int:
        number: Any = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.result_type(float))
        ends = tuple(PhaseEnds(number(p.n), number(p.n), number(), number()) for p in self.phases)
        return jax.eval_shape(lambda ends: self._links(ends), ends).shape[0]

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        ends = self._ends(x0, xf)
        pairs = zip(self.stated_phases(), ends, strict=True)
        return sum(p.endpoint_cost(*end) for p, end in pairs)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        """The phases' own constraints, the links, and the durations, which may not be negative."""
        ends = self._ends(x0, xf)
        pairs = zip(self.stated_phases(), ends, strict=True)
        own = [p.endpoint_constraints(*end) for p, end in pairs]
        durations = jnp.stack([end.tf - end.t0 for end in ends])
        return jnp.concatenate([*own, self._links(ends), durations])

    def split(self, extremal: Kind) -> tuple[Kind, ...]:
        """An extremal of each phase in its own time, between the states it has at its ends; the
        end of the last is as stated. Durations must be positive."""
        problem = extremal.problem
        assert isinstance(problem, Phased)
        none: Any = [None] * len(self.phases)
        per_state = lambda y: none if y is None else problem.split_state(y)
        per_control = lambda y: none if y is None else problem.split_control(y)
        m = extremal.multipliers
        cut = lambda y, sizes: jnp.split(y, np.cumsum(sizes)[:-1], axis=-1)
        path = cut(m.path, [count(p, "path_constraints") for p in problem.phases])
        integral = cut(m.integral, [count(p, "integrands") for p in problem.phases])
        own = [endpoint_count(p) for p in problem.phases]
        nu = cut(m.endpoint[: sum(own)], own)
        out = []
        stated = zip(problem.stated_phases(), problem.horizons(), strict=True)
        for i, (phase, (t0, tf)) in enumerate(stated):
            span = tf - t0
            covectors = Multipliers(
                nu[i], path[i] / span, per_state(m.state)[i] / span,
                per_control(m.control)[i] / span, integral[i],
            )  # fmt: skip
            x, costate = per_state(extremal.x)[i], per_state(extremal.costate)[i]
            phase = restated(phase, initial_time=t0, final_time=tf, initial_state=tuple(x[0]))
            if i + 1 < len(problem.phases):
                # The multiplier of the given final state: transversality, 2002 paper, eq. (8) with
                # the sign of `Extremal`.
                pull = jax.grad(phase.endpoint_cost, argnums=1)(x[0], x[-1], t0, tf)
                covectors = dataclasses.replace(covectors, endpoint=costate[-1] - pull)
                phase = Linked(phase, **own_fields(phase, endpoint_bounds=(x[-1], x[-1])))
            out.append(
                dataclasses.replace(
                    extremal, t=t0 + span * extremal.t, final_time=jnp.asarray(tf),
                    x=x, u=per_control(extremal.u)[i],
                    costate=costate, multipliers=covectors, problem=phase,
                    u_before=per_control(extremal.u_before)[i],
                    costate_before=per_state(extremal.costate_before)[i], chosen=None,
                )
            )  # fmt: skip
        return tuple(out)


def _join(pairs: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    return xp.concatenate([a for a, _ in pairs]), xp.concatenate([b for _, b in pairs])


def _starts(phases: tuple[Problem, ...]) -> tuple[Any, ...]:
    """Initial entries of all phases. One that is free without a guess gets as its guess the start
    of the state of the same name in the phase before."""
    seen: dict[str, Any] = {}
    out = []
    for phase in phases:
        for name, entry in zip(phase.state_names, initial_entries(phase), strict=True):
            if is_free(entry) and entry.guess is None and name in seen:
                entry = Free(entry.lo, entry.hi, seen[name])
            seen[name] = start_value(entry)
            out.append(entry)
    return tuple(out)


def _as_text(time: Any) -> str:
    return f"[{time.lo}, {time.hi}]" if is_free(time) else str(time)
