"""Sums of chunks added up to those of a sweep. Host only."""

import numpy as np

from jaxguide.sweeping.ranking import merged


class Totals:
    """Adds up the sums of chunks, by `Tiles.chunk`; the totals have the same bits in whatever order
    chunks are added.

    Moments are kept tile by tile, since sums of floats depend on their order; the other sums are of
    integers.
    """

    def __init__(self):
        self._moments: dict[int, np.ndarray] = {}
        self._others: dict[str, np.ndarray] = {}

    def add(self, k: int, sums: dict[str, np.ndarray]) -> None:
        """Adds the sums of chunk `k`."""
        self._moments[k] = sums["moments"]
        for name in sums.keys() - {"moments", "worst", "unit"}:
            self._others[name] = self._others.get(name, 0) + sums[name]
        self._others["unit"] = sums["unit"]  # the same in every chunk
        worst = [self._others["worst"]] if "worst" in self._others else []
        self._others["worst"] = merged(*worst, sums["worst"])

    def all(self) -> dict[str, np.ndarray]:
        """The totals of the chunks added: `moments` (tile, ...) in the order of tiles, `histogram`,
        `codes` (result,), `bins`, `unit` (k,) and the table `worst`."""
        ordered = [self._moments[k] for k in sorted(self._moments)]
        return {"moments": np.concatenate(ordered), **self._others}
