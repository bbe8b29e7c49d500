"""Sums, largest entries and moves of pytrees of arrays: the vector algebra of the optimiser."""

import functools
import operator
from typing import Any

import jax
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, xp

_tree = jax.tree_util.tree_map


def total(tree: Any) -> Float[Array, ""]:
    """Sum of all entries; 0 if there are none."""
    sums = map(xp.sum, jax.tree_util.tree_leaves(tree))
    return functools.reduce(operator.add, sums, xp.zeros(()))


def largest(tree: Any) -> Float[Array, ""]:
    """Largest absolute value of all entries; 0 if there are none."""
    leaves = [xp.max(xp.abs(a), initial=0.0) for a in jax.tree_util.tree_leaves(tree)]
    return xp.max(xp.stack(leaves))


def one_norm(tree: Any) -> Float[Array, ""]:
    """Sum of the absolute values of all entries."""
    return total(_tree(xp.abs, tree))


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether every entry is finite."""
    return xp.isfinite(one_norm(tree))


def entries(tree: Any) -> int:
    """How many numbers a pytree holds."""
    return sum(a.size for a in jax.tree_util.tree_leaves(tree))


def choose(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    """`yes` or `no`, two pytrees of one structure."""
    return _tree(lambda a, b: xp.where(condition, a, b), yes, no)


def along(start: Any, length: Float[Array, ""], direction: Any) -> Any:
    """`start + length * direction`."""
    return _tree(lambda a, d: a + length * d, start, direction)


def zeros_like(tree: Any) -> Any:
    """A pytree of zeros."""
    return _tree(xp.zeros_like, tree)
