"""The variables of a design: leaves that smooth maps keep within bounds or in order.

A design is any pytree of floating arrays. An optimiser moves unconstrained numbers; a `Bounded` or
`Ascending` node holds such numbers and stands for their image, which alone `build` sees. Compared
with clipping after each step, the map has no corner at which momentum and gradient disagree, and
the derivative is that of the objective as stated; in return, a bound is approached and never
reached.
"""

import abc
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Mapped(eqx.Module):
    """Abstract: a leaf whose `value` is the image of unconstrained numbers `raw`."""

    raw: eqx.AbstractVar[Array]

    @property
    @abc.abstractmethod
    def value(self) -> Array:
        """The image of `raw`, which `build` is given."""


class Bounded(Mapped):
    r"""A leaf between `lo` and `hi`, of any shape: $lo + (hi - lo)\,\sigma(raw)$; with one bound,
    exponential.

    **Arguments:** `value`: where to start, strictly within; `lo`, `hi`: numbers, infinite if none.

    **Raises:** `ValueError` for a start that is not within its bounds.
    """

    raw: Array
    lo: float = eqx.field(static=True)
    hi: float = eqx.field(static=True)

    def __init__(self, value: Any, lo: float = -math.inf, hi: float = math.inf):
        self.lo, self.hi = float(lo), float(hi)
        start = np.asarray(value, float)
        if not np.all((start > self.lo) & (start < self.hi)):
            raise ValueError(
                f"Bounded: value {value} is not between lo = {lo} and hi = {hi}; start within, not "
                "on a bound, which is never reached."
            )
        if math.isfinite(self.lo) and math.isfinite(self.hi):
            raw = np.log((start - self.lo) / (self.hi - start))
        elif math.isfinite(self.lo):
            raw = np.log(start - self.lo)
        elif math.isfinite(self.hi):
            raw = -np.log(self.hi - start)
        else:
            raw = start
        self.raw = jnp.asarray(raw, jnp.result_type(float))

    @property
    def value(self) -> Array:
        if math.isfinite(self.lo) and math.isfinite(self.hi):
            return self.lo + (self.hi - self.lo) * jax.nn.sigmoid(self.raw)
        if math.isfinite(self.lo):
            return self.lo + jnp.exp(self.raw)
        if math.isfinite(self.hi):
            return self.hi - jnp.exp(-self.raw)
        return self.raw


class Ascending(Mapped):
    r"""Ascending numbers $v_1 < \ldots < v_k$, the first and the last fixed; the spacings are
    $(v_k - v_1)\,\mathrm{softmax}(raw)$.

    **Arguments:** `value` (k,): where to start, ascending.

    **Raises:** `ValueError` for numbers out of order, or fewer than three, of which none can move.
    """

    raw: Float[Array, " k_1"]
    lo: float = eqx.field(static=True)
    hi: float = eqx.field(static=True)

    def __init__(self, value: Any):
        start = np.asarray(value, float)
        if start.ndim != 1 or start.size < 3 or not np.all(np.diff(start) > 0):
            raise ValueError(
                f"Ascending: value is {value}; give at least three places in ascending order, the "
                "first and the last of which stay."
            )
        self.lo, self.hi = float(start[0]), float(start[-1])
        logits = np.log(np.diff(start))
        self.raw = jnp.asarray(logits - logits.mean(), jnp.result_type(float))

    @property
    def value(self) -> Float[Array, " k"]:
        inner = jnp.cumsum(jax.nn.softmax(self.raw))[:-1]
        ends = jnp.zeros(1, inner.dtype), jnp.ones(1, inner.dtype)
        return self.lo + (self.hi - self.lo) * jnp.concatenate([ends[0], inner, ends[1]])


def values(design: Any) -> Any:
    """`design` with the value of every `Bounded` and `Ascending` in its place."""
    mapped = lambda node: isinstance(node, Mapped)
    change = lambda node: node.value if isinstance(node, Mapped) else node
    return jax.tree_util.tree_map(change, design, is_leaf=mapped)


def named(design: Any) -> dict[str, Any]:
    """The leaves of `design` by their path, such as "nodes" or "law.gain"; a design that is one
    array has the name "design"."""
    found = jax.tree_util.tree_flatten_with_path(design)[0]
    return {_name(path): leaf for path, leaf in found}


def _name(path: tuple) -> str:
    parts = [str(getattr(p, "name", getattr(p, "key", getattr(p, "idx", p)))) for p in path]
    if parts and parts[-1] == "raw":
        parts = parts[:-1]
    return ".".join(parts) or "design"


def checked(design: Any) -> Any:
    """`design` with its numbers as JAX arrays.

    **Raises:** `ValueError` for a leaf that is not floating or not finite, or if there is no leaf.
    """
    leaves = named(design)
    if not leaves:
        raise ValueError(
            "tune: the design has no leaves; give a pytree of floating arrays, such as "
            '{"interval": jnp.asarray(0.1)}.'
        )
    for name, leaf in leaves.items():
        array = np.asarray(leaf)
        if not np.issubdtype(array.dtype, np.floating):
            raise ValueError(
                f"tune: design leaf {name!r} is {leaf!r} of type {array.dtype}, which has no "
                "derivative; give floats (a count: relax it, see jaxguide.tuning.relaxation)."
            )
        if not np.all(np.isfinite(array)):
            raise ValueError(f"tune: design leaf {name!r} is {leaf}; start from finite numbers.")
    to_array = lambda a: jnp.asarray(a, np.asarray(a).dtype)
    return jax.tree_util.tree_map(to_array, design)
