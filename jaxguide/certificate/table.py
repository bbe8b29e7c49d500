"""The Certificate: how good an extremal is, each necessary condition as a number with its bound."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, xp


class Certificate(eqx.Module):
    """Rows of checks, one a condition. `passed` is a bool array; printed, it is a table that names
    the worst place.

    Of a batch of extremals every array has a leading axis of lanes; printed, each row is that of
    the worst lane."""

    names: tuple[str, ...] = eqx.field(static=True)
    labels: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    value: Float[Array, " row"]
    tolerance: Float[Array, " row"]
    time: Float[Array, " row"]
    component: Array

    @property
    def passed(self) -> Bool[Array, " row"]:
        """Whether each row's value is within its tolerance."""
        return self.value <= self.tolerance  # NaN fails

    def worst(self) -> "Certificate":
        """The rows of a batch, each from the lane where it is furthest beyond its bound."""
        # 1e-300: rows with the bound 0 are not divided by it.
        beyond = jnp.where(
            jnp.isnan(self.value), jnp.inf, self.value / jnp.maximum(self.tolerance, 1e-300)
        )
        lane = jnp.argmax(beyond, axis=0)
        pick = lambda a: jnp.take_along_axis(a, lane[None], axis=0)[0]
        return jax.tree_util.tree_map(pick, self)

    def __str__(self) -> str:
        if self.value.ndim == 2:
            passed = np.asarray(jnp.all(self.passed, axis=1))
            return f"{passed.sum()} of {len(passed)} lanes pass; at worst:\n{self.worst()}"
        width = max(len(name) for name in self.names)
        lines = []
        for name, labels, value, tolerance, time, component, passed in self._by_row():
            where = f"{labels[int(component) % len(labels)]} at t = {time:.6g}" if labels else ""
            verdict = "ok   " if passed else "FAILS"
            lines.append(f"{verdict} {name:{width}s} {value:9.2e} <= {tolerance:7.1e}  {where}")
        return "\n".join(lines)

    def _by_row(self) -> Any:
        """Name, labels, value, tolerance, time, component and verdict of each row."""
        value, tolerance = np.asarray(self.value), np.asarray(self.tolerance)
        where = (np.asarray(self.time), np.asarray(self.component))
        passed = value <= tolerance
        return zip(self.names, self.labels, value, tolerance, *where, passed, strict=True)

    def rows(self) -> list[dict[str, Any]]:
        """The table as plain data; of a batch, at its worst."""
        if self.value.ndim == 2:
            return self.worst().rows()
        return [
            {
                "check": name,
                "value": float(v),
                "tolerance": float(tol),
                "time": float(t),
                "where": labels[int(c) % len(labels)] if labels else "",
                "passed": bool(p),
            }
            for name, labels, v, tol, t, c, p in self._by_row()
        ]


class Checks:
    """Collects rows."""

    def __init__(self):
        self.names, self.labels = [], []
        self.value, self.tolerance, self.time, self.component = [], [], [], []

    @classmethod
    def of(cls, certificate: Certificate) -> "Checks":
        """The rows of a certificate, to be followed by others."""
        c, rows = certificate, cls()
        rows.names, rows.labels = list(c.names), list(c.labels)
        rows.value, rows.tolerance = list(c.value), list(c.tolerance)
        rows.time, rows.component = list(c.time), list(c.component)
        return rows

    def add(self, name: str, labels: Any, values: Array, times: Array, tolerance: float) -> None:
        """`values` (k, c): errors of components named by `labels` at `times` (k,)."""
        if values.size == 0:
            return
        values = xp.abs(values)
        flat = xp.where(xp.isnan(values), xp.inf, values)
        worst = xp.argmax(flat)
        node, component = worst // values.shape[1], worst % values.shape[1]
        self.names.append(name)
        self.labels.append(tuple(labels))
        self.value.append(values[node, component])
        self.tolerance.append(xp.asarray(tolerance, values.dtype))
        self.time.append(times[node])
        self.component.append(component)

    def add_signed(
        self, name: str, labels: Any, value: Array, time: Array, tolerance: float
    ) -> None:
        """One signed number that must not exceed `tolerance`."""
        self.names.append(name)
        self.labels.append(tuple(labels))
        self.value.append(value)
        self.tolerance.append(xp.asarray(tolerance, value.dtype))
        self.time.append(time)
        self.component.append(xp.zeros((), jnp.int64 if value.dtype == jnp.float64 else jnp.int32))

    def done(self) -> Certificate:
        """The Certificate of all rows."""
        stack = lambda parts: xp.stack(parts)
        return Certificate(
            tuple(self.names),
            tuple(self.labels),
            stack(self.value),
            stack(self.tolerance),
            stack(self.time),
            stack(self.component),
        )
