"""An Extremal with its certificate: what `jg.solve` returns."""

import dataclasses

import equinox as eqx
import jax

from jaxguide.certificate.certify import certify
from jaxguide.certificate.table import Certificate
from jaxguide.trajectory import Extremal

_FIELDS = tuple(field.name for field in dataclasses.fields(Extremal))


class Certified(Extremal):
    """An Extremal that knows how accurate its method means to be, and so how to be judged.

    `accuracy`: the relative error up to which a row of its certificate passes.
    """

    accuracy: float = eqx.field(static=True, kw_only=True)

    @property
    def certificate(self) -> Certificate:
        """How good this extremal is: every check, computed when asked for. Of a batch, as from
        `jg.solve_batch`, with a leading axis of lanes. With costly rows: `jg.certify`."""
        one = lambda extremal: certify(extremal, tolerance=self.accuracy)
        return jax.vmap(one)(self) if self.t.ndim == 2 else one(self)


def certified(extremal: Extremal, accuracy: float) -> Certified:
    """`extremal` with its certificate."""
    return Certified(**{name: getattr(extremal, name) for name in _FIELDS}, accuracy=accuracy)


def uncertified(extremal: Extremal) -> Extremal:
    """`extremal` without its certificate: a guess is the same to a compiled program whether a
    method or `jg.solve` made it."""
    return Extremal(**{name: getattr(extremal, name) for name in _FIELDS})
