"""How good an extremal is: its Certificate, computed independently of its solver."""

from jaxguide.certificate import checks, costly
from jaxguide.certificate.along import Along
from jaxguide.certificate.table import Certificate, Checks
from jaxguide.host.compilation import kept_quickly
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import closed


def certify(extremal: Extremal, costly: bool = False, tolerance: float = 1e-9) -> Certificate:
    """Checks an extremal against the conditions it should meet, independently of its solver.

    **Arguments:** `tolerance`: of the relative errors; `costly`: also fly the interpolated control
    with an adaptive integrator (Diffrax, 1e-11) and compare with the extremal's own states; and
    look for conjugate points, past which an extremal minimises nothing, by a backward sweep of its
    second variation. Errors are relative to the sizes of the quantities compared, so the
    tolerance holds in any units.

    **Source:** 2002 paper, eqs (2)-(9); review, section 4.
    """
    return _certified(extremal, costly, tolerance)


@kept_quickly
def _certified(extremal: Extremal, fly: bool, tight: float) -> Certificate:
    rows, along = Checks(), Along(extremal if extremal.stretch is None else closed(extremal))
    if fly:
        costly.propagation(rows, along)
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
