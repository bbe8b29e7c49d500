"""The known optimum of a problem, as data: to check against, never to compute with."""

from typing import NamedTuple


class Reference(NamedTuple):
    """The known optimum of a problem.

    - `value`: the least objective, which is minimised. `uncertainty`: of `value`, absolute.
    - `basis`: how `value` was found: a closed form; "independent", computed without this package,
      on two meshes or with each arc a phase; or published.
    - `source`: of the problem, and of the constants in its class.
    - `trap`: published values that are wrong, and other easy mistakes.
    """

    value: float
    uncertainty: float
    basis: str
    source: str
    trap: str = ""
