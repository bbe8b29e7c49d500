"""Where a sweep keeps its chunks: the calls that files and memory both serve. Host only."""

import abc
import contextlib
import sys
import threading
from typing import Any

import numpy as np


def import_beside() -> None:
    """Imports xarray, and all that it imports at its first Dataset, in a thread of its own: half a
    second or more, which passes while XLA compiles. Whoever imports it meanwhile waits."""

    def imported() -> None:
        with contextlib.suppress(Exception):  # whoever needs it says so better
            import xarray as xr

            xr.Dataset({"none": ("case", np.zeros(1))})

    if "xarray" not in sys.modules:
        threading.Thread(target=imported, daemon=True).start()


class AbstractStore(abc.ABC):
    """Abstract: keeps the cases and sums of a sweep, chunk by chunk."""

    @abc.abstractmethod
    def has(self, k: int) -> bool:
        """Whether chunk `k` is there from an earlier run, exactly as it was written."""

    @abc.abstractmethod
    def write(self, k: int, rows: dict[str, np.ndarray], sums: dict[str, np.ndarray]) -> None:
        """Keeps chunk `k`: name -> values (case, ...), and name -> sums, by `Tiles.chunk`.

        **Raises:** `OSError` if it does not fit; the chunks before it are kept.
        """

    @abc.abstractmethod
    def sums(self, k: int) -> dict[str, np.ndarray]:
        """The sums of chunk `k`, for which `has(k)` holds."""

    @abc.abstractmethod
    def results(self) -> np.ndarray:
        """(case,): the result code of every case."""

    @abc.abstractmethod
    def stop_at(self, cases: int) -> None:
        """Keeps only the first `cases` cases, which fill whole chunks."""

    @abc.abstractmethod
    def finished(self, cases: np.ndarray) -> bool:
        """Whether the sweep was finished and the full flights of `cases` are there as written."""

    @abc.abstractmethod
    def finish(self, summary: dict[str, Any], histories: dict[str, Any]) -> None:
        """Keeps the statistics of the sweep and its full flights: name -> (dimensions, values).

        **Raises:** `OSError` if they do not fit; the cases are kept.
        """

    @abc.abstractmethod
    def dataset(self, attrs: dict[str, Any]) -> Any:
        """The cases and full flights as an xarray Dataset with `attrs`."""


class Memory(AbstractStore):
    """Keeps everything in memory, for one run.

    **Arguments:** `variables`: name -> dimensions, shape and type of each variable of a case;
    `coordinates`: dimension -> names along it; `cases`: of the whole sweep.
    """

    def __init__(self, variables: Any, coordinates: dict[str, np.ndarray], cases: int):
        self.variables, self.coordinates, self.cases = variables, coordinates, cases
        self._rows: dict[int, dict[str, np.ndarray]] = {}
        self._histories: dict[str, Any] = {}

    def has(self, k: int) -> bool:
        return False

    def write(self, k: int, rows: dict[str, np.ndarray], sums: dict[str, np.ndarray]) -> None:
        self._rows[k] = rows

    def sums(self, k: int) -> dict[str, np.ndarray]:
        raise KeyError(k)  # it has no chunk of an earlier run

    def _joined(self, name: str) -> np.ndarray:
        return np.concatenate([self._rows[k][name] for k in sorted(self._rows)])

    def results(self) -> np.ndarray:
        return self._joined("result")

    def stop_at(self, cases: int) -> None:
        self.cases = cases

    def finished(self, cases: np.ndarray) -> bool:
        return False

    def finish(self, summary: dict[str, Any], histories: dict[str, Any]) -> None:
        self._histories = {f"history_{name}": values for name, values in histories.items()}

    def dataset(self, attrs: dict[str, Any]) -> Any:
        import xarray as xr

        joined = {name: (dims, self._joined(name)) for name, (dims, _, _) in self.variables.items()}
        coords = {"case": np.arange(self.cases), **self.coordinates}
        return xr.Dataset(joined | self._histories, coords=coords, attrs=attrs)
