"""A sweep's Zarr store: written chunk by chunk, killed at any instant, gone on with. Host only.

Cases lie in the root group, so that `xr.open_zarr` shows them and nothing else. The group `partial`
holds each tile's moments and each chunk's histogram and, written last, its digest: a chunk counts
only if its digest is there and right. Zarr replaces whole files, so none is ever half new. The
group `histories` holds some flights in full; the root's attribute `summary`, written last of all,
what the sweep found.
"""

import contextlib
import errno
import hashlib
import json
import math
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxguide.sweeping.ranking import merged

FORMAT = 2
_DIGEST = 32  # bytes
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Store:
    """Opens or makes the store at `path` for a sweep that `manifest` describes.

    **Raises:** `ValueError` where another sweep's results lie there, naming what differs, or where
    some lie there and `resume` is not set; `OSError` where nothing can be written.
    """

    def __init__(
        self,
        path: Path,
        manifest: dict[str, Any],
        variables: dict[str, tuple[tuple[str, ...], tuple[int, ...], Any]],
        coordinates: dict[str, np.ndarray],  # names
        chunk: int,
        resume: bool,
        about: dict[str, Any] | None = None,  # for people; not compared
    ):
        zarr = _zarr()
        self.path, self.chunk = Path(path), chunk
        self.cases = int(manifest["cases"])
        self.chunks = -(-self.cases // chunk)
        self._about = about or {}
        manifest = {"format": FORMAT, "chunk": chunk, **manifest}
        found = self._found()
        if found is None and self.path.exists() and any(self.path.iterdir()):
            raise ValueError(
                f"{self.path} holds files but no sweep; give an empty or a new directory."
            )
        if found is not None:
            _same(manifest, found, self.path)
            if not resume:
                raise ValueError(
                    f"{self.path} already holds this sweep, or a part of it; pass resume=True "
                    "(--resume) to go on with it, or give another directory."
                )
            for left in self.path.rglob("*.partial"):
                left.unlink()
        else:
            self._make(zarr, manifest, variables, coordinates)
        self.root = zarr.open_group(self.path, mode="r+")
        self.partial: Any = self.root["partial"]
        self.names = sorted(variables)
        if "flown" in self.root.attrs:
            self._cut(int(self.root.attrs["flown"]))  # pyright: ignore[reportArgumentType]

    def _found(self) -> dict[str, Any] | None:
        """The manifest of what lies there; none where its making was not finished."""
        described = self.path / "zarr.json"
        if not described.exists():
            return None
        attributes = json.loads(described.read_text()).get("attributes", {})
        return attributes.get("sweep")

    def _make(self, zarr: Any, manifest: Any, variables: Any, coordinates: Any) -> None:
        """Everything beside the final path first, then moved there at once."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        beside = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}")
        root = zarr.open_group(beside, mode="w", zarr_format=3)
        for name, (dims, shape, dtype) in variables.items():
            root.create_array(
                name, shape=(self.cases, *shape), chunks=(self.chunk, *(max(k, 1) for k in shape)),
                dtype=dtype, dimension_names=dims,
            )  # fmt: skip
        for name, values in coordinates.items():
            array = root.create_array(
                name, shape=values.shape, chunks=values.shape, dtype="string",
                dimension_names=(name,),
            )  # fmt: skip
            array[...] = values
        root.create_group("partial").create_array(
            "digest", shape=(self.chunks, _DIGEST), chunks=(1, _DIGEST), dtype="uint8"
        )
        root.attrs["about"] = plain(self._about)
        root.attrs["sweep"] = manifest  # last: what has it is whole
        if self.path.exists():
            self.path.rmdir()
        beside.rename(self.path)

    def write(self, k: int, rows: dict[str, np.ndarray], sums: dict[str, np.ndarray]) -> None:
        """Chunk `k`: its cases and its sums, then its digest.

        **Raises:** `OSError` where it does not fit; the chunks before it are kept.
        """
        with self._room():
            self._write(k, rows, sums)

    @contextlib.contextmanager
    def _room(self) -> Iterator[None]:
        try:
            yield
        except OSError as e:
            if e.errno not in _FULL:
                raise
            raise OSError(
                e.errno,
                f"{self.path}: {os.strerror(e.errno)}. What was written is kept: free some space, "
                "or move the store to where there is, and go on with resume=True (--resume).",
            ) from e

    def _write(self, k: int, rows: dict[str, np.ndarray], sums: dict[str, np.ndarray]) -> None:
        at = slice(k * self.chunk, min((k + 1) * self.chunk, self.cases))
        for name, values in rows.items():
            self.root[name][at] = values[: at.stop - at.start]
        for name, values in sums.items():
            if name not in self.partial:
                self.partial.create_array(
                    name, shape=(self.chunks, *values.shape), chunks=(1, *values.shape),
                    dtype=values.dtype,
                )  # fmt: skip
            self.partial[name][k] = values
        self.partial["digest"][k] = _digest(self.read(k))

    def read(self, k: int) -> dict[str, np.ndarray]:
        """Everything of chunk `k`."""
        at = slice(k * self.chunk, min((k + 1) * self.chunk, self.cases))
        rows = {name: self.root[name][at] for name in self.names}
        sums = {f"partial/{n}": a[k] for n, a in sorted(self.partial.arrays()) if n != "digest"}
        return rows | sums

    def sums(self, k: int) -> dict[str, np.ndarray]:
        """The sums of chunk `k`."""
        return {name: a[k] for name, a in self.partial.arrays() if name != "digest"}

    def results(self) -> np.ndarray:
        """Every case's result."""
        return self.root["result"][: self.cases]

    def stop_at(self, cases: int) -> None:
        """Keeps the first `cases` cases, whole chunks, alone."""
        if cases < self.cases:
            self.root.attrs["flown"] = cases  # first: resizing may be cut short, and is done again
            self._cut(cases)

    def _cut(self, cases: int) -> None:
        for name in self.names:
            array = self.root[name]
            if array.shape[0] > cases:
                array.resize((cases, *array.shape[1:]))
        self.cases = cases

    def finished(self, cases: np.ndarray) -> bool:
        """Whether the flights in full of `cases` are there, as they were written."""
        if "summary" not in self.root.attrs:
            return False
        if not len(cases):
            return "histories" not in self.root
        try:
            group: Any = self.root["histories"]
            values = {name: array[...] for name, array in group.arrays()}
            told = _digest(values).tobytes().hex()
            return np.array_equal(values["case"], cases) and group.attrs["digest"] == told
        except Exception:  # whatever a codec says of a file cut short
            return False

    def finish(self, summary: dict[str, Any], histories: dict[str, Any]) -> None:
        """What the sweep found, and flights in full: name -> (dimensions, values).

        **Raises:** `OSError` where it does not fit; the cases are kept.
        """
        with self._room():
            self._finish(summary, histories)

    def _finish(self, summary: dict[str, Any], histories: dict[str, Any]) -> None:
        if histories:
            group = self.root.create_group("histories", overwrite=True)
            for name, (dims, values) in histories.items():
                group.create_array(
                    name, shape=values.shape, chunks=values.shape, dtype=values.dtype,
                    dimension_names=dims,
                )[...] = values  # fmt: skip
            told = _digest({name: values for name, (_, values) in histories.items()})
            group.attrs["digest"] = told.tobytes().hex()
        self.root.attrs["summary"] = plain(summary)

    def has(self, k: int) -> bool:
        """Whether chunk `k` is there and as it was written."""
        try:
            written = self.partial["digest"][k]
            return bool(written.any()) and np.array_equal(written, _digest(self.read(k)))
        except Exception:  # whatever a codec says of a file cut short
            return False

    def dataset(self, attrs: dict[str, Any]) -> Any:
        """The cases, read when asked for, with `attrs`."""
        return opened(self.path).assign_attrs(attrs)


def opened(path: Path) -> Any:
    """The Dataset of the sweep stored at `path`, read when asked for; its attributes are those that
    `jg.sweep` gives, but for times.

    **Raises:** `ValueError` where there is none; `RuntimeError` without zarr.
    """
    import xarray as xr

    _zarr()
    told = described(path)
    lazy = xr.open_zarr(path, consolidated=False, chunks=None).drop_attrs()
    parts = [lazy.assign_coords(case=np.arange(lazy.sizes["case"]))]
    if (Path(path) / "histories" / "zarr.json").exists():
        full = xr.open_zarr(path, group="histories", consolidated=False, chunks=None)
        parts.append(full.rename({name: f"history_{name}" for name in full.data_vars}))
    manifest = {name: told["sweep"].get(name) for name in ("cases", "seed", "tile", "dtype")}
    attrs = manifest | {"about": told.get("about", {})} | told.get("summary", {})
    return xr.merge(parts).assign_attrs(attrs)


def histograms(path: Path) -> np.ndarray:
    """(k, BINS): the histogram of every quantity over all cases of the sweep stored at `path`."""
    array: Any = _zarr().open_group(path, mode="r")["partial/histogram"]
    total = np.zeros(array.shape[1:], np.int64)
    for k in range(array.shape[0]):
        total += array[k]
    return total


def described(path: Path) -> dict[str, Any]:
    """The attributes of the store at `path`: "sweep", its manifest; "about"; "summary" if whole.

    **Raises:** `ValueError` where there is none.
    """
    file = Path(path) / "zarr.json"
    told = json.loads(file.read_text()).get("attributes", {}) if file.exists() else {}
    if "sweep" not in told:
        raise ValueError(f"{path} holds no sweep.")
    return told


def stored(path: Path, case: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What the sweep at `path` was, and what it keeps of `case`.

    **Raises:** `ValueError` where there is none, or none of a named mission.
    """
    told = described(path)
    manifest = told["sweep"]
    if manifest.get("label") is None:
        raise ValueError(
            f"{path} is of no mission of the library; call jg.rerun(mission, dispersions, seed, "
            "case) with its own."
        )
    cases = told.get("flown", manifest["cases"])
    if not 0 <= case < cases:
        raise ValueError(f"case is {case}; {path} has 0 to {cases - 1}.")
    root = _zarr().open_group(path, mode="r")
    rows = {name: a[case] for name, a in root.arrays() if a.shape[:1] == (cases,)}
    return manifest | {"about": told.get("about", {})}, rows


class Totals:
    """Adds up the sums of chunks, in whatever order they come."""

    def __init__(self):
        self._moments: dict[int, np.ndarray] = {}
        self._others: dict[str, np.ndarray] = {}

    def add(self, k: int, sums: dict[str, np.ndarray]) -> None:
        self._moments[k] = sums["moments"]
        for name in sums.keys() - {"moments", "worst", "unit"}:
            self._others[name] = self._others.get(name, 0) + sums[name]
        self._others["unit"] = sums["unit"]  # of every chunk the same
        worst = [self._others["worst"]] if "worst" in self._others else []
        self._others["worst"] = merged(*worst, sums["worst"])

    def all(self) -> dict[str, np.ndarray]:
        ordered = [self._moments[k] for k in sorted(self._moments)]
        return {"moments": np.concatenate(ordered), **self._others}


class Memory:
    """What a Store is, without files."""

    def __init__(self, variables: Any, coordinates: dict[str, np.ndarray], cases: int, chunk: int):
        self.variables, self.coordinates = variables, coordinates
        self.cases, self.chunks = cases, -(-cases // chunk)
        self._rows: dict[int, dict[str, np.ndarray]] = {}
        self._histories: dict[str, Any] = {}

    def has(self, k: int) -> bool:
        return False

    def write(self, k: int, rows: dict[str, np.ndarray], sums: dict[str, np.ndarray]) -> None:
        self._rows[k] = rows

    def _joined(self, name: str) -> np.ndarray:
        return np.concatenate([self._rows[k][name] for k in sorted(self._rows)])

    def results(self) -> np.ndarray:
        return self._joined("result")

    def stop_at(self, cases: int) -> None:
        self.cases = cases

    def finished(self, cases: np.ndarray) -> bool:
        return False

    def finish(self, summary: dict[str, Any], histories: dict[str, Any]) -> None:
        self._histories = {f"history_{name}": told for name, told in histories.items()}

    def dataset(self, attrs: dict[str, Any]) -> Any:
        import xarray as xr

        joined = {name: (dims, self._joined(name)) for name, (dims, _, _) in self.variables.items()}
        coords = {"case": np.arange(self.cases), **self.coordinates}
        return xr.Dataset(joined | self._histories, coords=coords, attrs=attrs)


def plain(value: Any) -> Any:
    """`value` as JSON has it: no arrays, tuples, or numbers that are not finite (null)."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _zarr() -> Any:
    try:
        import zarr
    except ImportError as e:
        raise RuntimeError(
            "a sweep's store needs zarr; install it with pip install 'jaxguide[sweep]'."
        ) from e
    return zarr


def _digest(values: dict[str, np.ndarray]) -> np.ndarray:
    sha = hashlib.sha256()
    for name in sorted(values):
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(values[name]).tobytes())
    return np.frombuffer(sha.digest(), np.uint8)


def _same(manifest: dict[str, Any], found: dict[str, Any], path: Path) -> None:
    told = differences(manifest, found)
    if told:
        raise ValueError(
            f"{path} was made by another sweep: {told}. Give another directory, or what made it."
        )


def differences(ours: dict[str, Any], theirs: dict[str, Any]) -> str:
    """What `theirs` has that `ours` has not, by name; "" where they are the same."""
    now, was = dict(_leaves(ours)), dict(_leaves(theirs))
    differ = sorted(k for k in now.keys() | was.keys() if now.get(k) != was.get(k))
    return ", ".join(f"{k} ({_short(was.get(k))}, now {_short(now.get(k))})" for k in differ)


def _leaves(d: dict[str, Any], prefix: str = "") -> Any:
    for key, value in d.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}: ")
        else:
            yield prefix + key, value


def _short(value: Any) -> str:
    text = str(value)
    return "absent" if value is None else text if len(text) < 20 else text[:8] + "..."
