"""Static parameters of a Problem: fields that hold `Free`, and the numbers a solver puts there."""

import dataclasses
from typing import Any

import equinox as eqx
from jaxtyping import Float

from jaxguide.arrays import Array, xp
from jaxguide.problem.statement import Free, Problem, is_free, start_value
from jaxguide.types import as_float

Path = tuple[str | int, ...]  # attributes and indices that lead from a Problem to a leaf


def with_parameters(problem: Problem, p: Any) -> Problem:
    """`problem` with the numbers `p` (k,) in place of its `Free` parameters; None: the numbers
    where a search for them starts."""
    paths = problem.parameter_paths()
    if not paths:
        return problem  # itself, and not a copy
    if p is None:
        p = [as_float(start_value(entry)) for entry in parameters(problem)]
    return placed_at(problem, paths, p)


def placed_at(problem: Problem, paths: tuple[Path, ...], p: Any) -> Problem:
    """`problem` with the entries of `p` at `paths`."""
    if not paths:
        return problem
    where = lambda q: [_follow(q, path) for path in paths]
    return eqx.tree_at(where, problem, [p[i] for i in range(len(paths))], is_leaf=is_free)


def parameters(problem: Problem, like: Problem | None = None) -> list[Any]:
    """The entries of `problem` at its own parameter paths, or at those of `like`."""
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
        """Their dotted paths, such as "phases.0.final_time"."""
        return tuple(".".join(map(str, path)) for path in self.paths)

    def values(self, problem: Problem) -> Float[Array, " k"]:
        """The numbers that `problem` holds for them."""
        return xp.stack([as_float(_follow(problem, path)) for path in self.paths])

    def into(self, problem: Problem, p: Array) -> Problem:
        """`problem` with the numbers `p` for them."""
        return placed_at(problem, self.paths, p)

    def unsettled(self, problem: Problem) -> Problem:
        """`problem` with a `Free` for each of its numbers, which is its guess."""
        sides = zip(*self.bounds, self.values(problem), strict=True)
        return placed_at(problem, self.paths, [Free(*side) for side in sides])


def choices(problem: Problem) -> Chosen | None:
    """The `Free` parameters of `problem`; None where there are none."""
    entries = parameters(problem)
    if not entries:
        return None
    side = lambda k: xp.stack([as_float(getattr(e, k)) for e in entries])
    return Chosen(problem.parameter_paths(), (side("lo"), side("hi")))


def replace_parameters(problem: Problem, names: tuple[str, ...], values: Any) -> Problem:
    """`problem` with its scalar fields `names` set to the entries of `values` (p,)."""
    return dataclasses.replace(problem, **{name: values[i] for i, name in enumerate(names)})
