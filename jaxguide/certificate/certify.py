"""How good an extremal is: its Certificate, computed independently of its solver."""

import jax
import numpy as np

from jaxguide.arrays import on_device
from jaxguide.certificate import checks, costly
from jaxguide.certificate.along import Along
from jaxguide.certificate.table import Certificate, Checks
from jaxguide.host.compilation import kept_quickly
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import closed
from jaxguide.types import is_traced


def certify(extremal: Extremal, costly: bool = False, tolerance: float = 1e-9) -> Certificate:
    """Checks an extremal against the conditions it should meet, independently of its solver.

    **Arguments:** `tolerance`: of the relative errors; `costly`: also fly the interpolated control
    with an adaptive integrator (Diffrax, 1e-11) and compare with the extremal's own states; and
    look for conjugate points, past which an extremal minimises nothing, by a backward sweep of its
    second variation. Errors are relative to the sizes of the quantities compared, so the
    tolerance holds in any units.

    **Source:** 2002 paper, eqs (2)-(9); review, section 4.
    """
    if is_traced(extremal):
        return _compiled(extremal, costly, tolerance)
    with np.errstate(all="ignore"):
        flown = Checks()
        if costly:
            flown = Checks.of(jax.device_get(_flown(extremal)))
        return on_device(_certified(jax.device_get(_closed(extremal)), flown, tolerance))


def _certified(extremal: Extremal, rows: Checks, tight: float) -> Certificate:
    """The certificate of all that `rows` holds already, and of the checks that nothing is flown
    for."""
    along = Along(extremal)
    for check in (
        checks.canonical_equations,
        checks.boundary,
        checks.energy,
        checks.jumps,
        checks.stationarity,
        checks.bounds,
        checks.integrals,
        checks.static_parameters,
        checks.spectral_tails,
    ):
        check(rows, along, tight)
    return rows.done()


@kept_quickly
def _finite(extremal: Extremal) -> Extremal:
    return closed(extremal)


def _closed(extremal: Extremal) -> Extremal:
    """`extremal` on a finite horizon."""
    return extremal if extremal.stretch is None else _finite(extremal)


@kept_quickly
def _compiled(extremal: Extremal, fly: bool, tight: float) -> Certificate:
    rows, extremal = Checks(), _closed(extremal)
    if fly:
        costly.propagation(rows, Along(extremal))
    return _certified(extremal, rows, tight)


@kept_quickly
def _flown(extremal: Extremal) -> Certificate:
    rows = Checks()
    costly.propagation(rows, Along(_closed(extremal)))
    return rows.done()
