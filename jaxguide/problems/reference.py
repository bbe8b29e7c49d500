"""What is known of a problem's optimum, as data: to check against, never to compute with."""

from typing import NamedTuple


class Reference(NamedTuple):
    """The least objective (of the minimised sense), how well it is known, and from where."""

    value: float
    uncertainty: float
    basis: str
    source: str
    trap: str = ""
