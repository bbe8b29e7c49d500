"""An Extremal with its certificate: what `jg.solve` returns."""

import dataclasses
from typing import Any

import equinox as eqx
import jax

from jaxguide.certificate.certify import certify
from jaxguide.certificate.table import Certificate
from jaxguide.trajectory import Extremal


class Certified(Extremal):
    """An Extremal with the accuracy that its method aims at.

    `accuracy`: the relative error up to which a row of its certificate passes.
    """

    accuracy: float = eqx.field(static=True, kw_only=True)

    @property
    def certificate(self) -> Certificate:
        """The checks of this extremal, computed at each access; of a batch (`jg.solve_batch`) with
        a leading axis of lanes. `jg.certify` also has the costly ones."""
        one = lambda extremal: certify(extremal, tolerance=self.accuracy)
        return jax.vmap(one)(self) if self.t.ndim == 2 else one(self)


def certified(extremal: Extremal, accuracy: float) -> Certified:
    """`extremal`, or a batch of them, with its certificate."""
    one = lambda e: Certified(**_fields(e), accuracy=accuracy)
    return jax.vmap(one)(extremal) if extremal.t.ndim == 2 else one(extremal)


def uncertified(extremal: Extremal) -> Extremal:
    """`extremal`, or a batch of them, without its certificate: as a guess it is the same to a
    compiled program whether a method or `jg.solve` made it."""
    one = lambda e: Extremal(**_fields(e))
    return jax.vmap(one)(extremal) if extremal.t.ndim == 2 else one(extremal)


def _fields(extremal: Extremal) -> dict[str, Any]:
    return {field.name: getattr(extremal, field.name) for field in dataclasses.fields(Extremal)}
