"""The Zarr store of a sweep: written chunk by chunk, so that a sweep killed at any instant can be
resumed. Host only.

Cases lie in the root group, so that `xr.open_zarr` shows them and nothing else. The group `partial`
holds each tile's moments, each chunk's histogram and, written last, the digest of the chunk: a
chunk is used only if its digest is present and right. Zarr replaces whole files, so no file is ever
half new. The group `histories` holds some flights in full. The root's attribute `sweep` is the
manifest; its attribute `summary`, written last of all, holds the statistics.
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

from jaxguide.sweeping.keeping import AbstractStore

FORMAT = 2  # of the files; what a manifest identifies a sweep by may change without it
_DIGEST = 32  # bytes of SHA-256
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Store(AbstractStore):
    """A directory of Zarr arrays.

    Opened at `path`, or made there, for the sweep that `manifest` describes.

    **Arguments:** `variables`: name -> dimensions, shape and type of each stored variable of a
    case; `coordinates`: dimension -> names along it; `chunk`: cases of a chunk; `resume`: whether
    results may already lie there; `about`: for people, not compared.

    **Raises:** `ValueError` if `path` holds another sweep (the message names the differences), or
    this one and `resume` is not set; `OSError` if nothing can be written.
    """

    def __init__(
        self,
        path: Path,
        manifest: dict[str, Any],
        variables: dict[str, tuple[tuple[str, ...], tuple[int, ...], Any]],
        coordinates: dict[str, np.ndarray],
        chunk: int,
        resume: bool,
        about: dict[str, Any] | None = None,
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
            _refuse_another(manifest, found, self.path)
            if not resume:
                raise ValueError(
                    f"{self.path} already holds this sweep, or a part of it; pass resume=True "
                    "(--resume) to continue it, or give another directory."
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
        """The manifest of the sweep at `path`; None if there is none that was made whole."""
        described = self.path / "zarr.json"
        if not described.exists():
            return None
        attributes = json.loads(described.read_text()).get("attributes", {})
        return attributes.get("sweep")

    def _make(self, zarr: Any, manifest: Any, variables: Any, coordinates: Any) -> None:
        """Makes the arrays beside the final path, then moves them there at once."""
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
        root.attrs["sweep"] = manifest  # last: a store that has it is whole
        if self.path.exists():
            self.path.rmdir()
        beside.rename(self.path)

    def write(self, k: int, rows: dict[str, np.ndarray], sums: dict[str, np.ndarray]) -> None:
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
                f"{self.path}: {os.strerror(e.errno)}. Chunks written before are kept: free some "
                "space, or move the store, and continue it with resume=True (--resume).",
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
        """Name -> array of all that is stored of chunk `k`, cases and sums, but for its digest."""
        at = slice(k * self.chunk, min((k + 1) * self.chunk, self.cases))
        rows = {name: self.root[name][at] for name in self.names}
        sums = {f"partial/{n}": a[k] for n, a in sorted(self.partial.arrays()) if n != "digest"}
        return rows | sums

    def sums(self, k: int) -> dict[str, np.ndarray]:
        return {name: a[k] for name, a in self.partial.arrays() if name != "digest"}

    def results(self) -> np.ndarray:
        return self.root["result"][: self.cases]

    def stop_at(self, cases: int) -> None:
        if cases < self.cases:
            # First: if the process is killed while it resizes, the next one resizes again.
            self.root.attrs["flown"] = cases
            self._cut(cases)

    def _cut(self, cases: int) -> None:
        for name in self.names:
            array = self.root[name]
            if array.shape[0] > cases:
                array.resize((cases, *array.shape[1:]))
        self.cases = cases

    def finished(self, cases: np.ndarray) -> bool:
        if "summary" not in self.root.attrs:
            return False
        if not len(cases):
            return "histories" not in self.root
        try:
            group: Any = self.root["histories"]
            values = {name: array[...] for name, array in group.arrays()}
            digest = _digest(values).tobytes().hex()
            return np.array_equal(values["case"], cases) and group.attrs["digest"] == digest
        except Exception:  # a codec may raise any error for a file cut short
            return False

    def finish(self, summary: dict[str, Any], histories: dict[str, Any]) -> None:
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
            digest = _digest({name: values for name, (_, values) in histories.items()})
            group.attrs["digest"] = digest.tobytes().hex()
        self.root.attrs["summary"] = plain(summary)

    def has(self, k: int) -> bool:
        try:
            written = self.partial["digest"][k]
            return bool(written.any()) and np.array_equal(written, _digest(self.read(k)))
        except Exception:  # a codec may raise any error for a file cut short
            return False

    def dataset(self, attrs: dict[str, Any]) -> Any:
        return open_store(self.path).assign_attrs(attrs)


def open_store(path: Path) -> Any:
    """The Dataset of the sweep stored at `path`, whose values are read when used.

    Its attributes are those that `jg.sweep` gives, without the measured times.

    **Raises:** `ValueError` if there is no sweep; `RuntimeError` without zarr.
    """
    import xarray as xr

    _zarr()
    described = attributes_of(path)
    lazy = xr.open_zarr(path, consolidated=False, chunks=None).drop_attrs()
    parts = [lazy.assign_coords(case=np.arange(lazy.sizes["case"]))]
    if (Path(path) / "histories" / "zarr.json").exists():
        full = xr.open_zarr(path, group="histories", consolidated=False, chunks=None)
        parts.append(full.rename({name: f"history_{name}" for name in full.data_vars}))
    manifest = {name: described["sweep"].get(name) for name in ("cases", "seed", "tile", "dtype")}
    attrs = manifest | {"about": described.get("about", {})} | described.get("summary", {})
    return xr.merge(parts).assign_attrs(attrs)


def total_histograms(path: Path) -> np.ndarray:
    """(k, BINS): the histogram of every quantity over all successful cases of the sweep stored at
    `path`."""
    array: Any = _zarr().open_group(path, mode="r")["partial/histogram"]
    total = np.zeros(array.shape[1:], np.int64)
    for k in range(array.shape[0]):
        total += array[k]
    return total


def attributes_of(path: Path) -> dict[str, Any]:
    """The attributes of the store at `path`: "sweep", its manifest; "about"; and, if the sweep was
    flown to its end, "summary". Read without zarr.

    **Raises:** `ValueError` if there is no sweep.
    """
    file = Path(path) / "zarr.json"
    attributes = json.loads(file.read_text()).get("attributes", {}) if file.exists() else {}
    if "sweep" not in attributes:
        raise ValueError(f"{path} holds no sweep.")
    return attributes


def stored(path: Path, case: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The manifest of the sweep at `path` with its `about`, and the stored variables of `case`.

    **Raises:** `ValueError` if there is no sweep, none of a named mission, or no such case.
    """
    attributes = attributes_of(path)
    manifest = attributes["sweep"]
    if manifest.get("label") is None:
        raise ValueError(
            f"{path} is of no mission of the library; call jg.rerun(mission, dispersions, seed, "
            "case) with the mission that was flown."
        )
    cases = attributes.get("flown", manifest["cases"])
    if not 0 <= case < cases:
        raise ValueError(f"case is {case}; {path} has 0 to {cases - 1}.")
    root = _zarr().open_group(path, mode="r")
    rows = {name: a[case] for name, a in root.arrays() if a.shape[:1] == (cases,)}
    return manifest | {"about": attributes.get("about", {})}, rows


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: lists for arrays, None for numbers that are not finite."""
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


def _refuse_another(manifest: dict[str, Any], found: dict[str, Any], path: Path) -> None:
    differing = differences(manifest, found)
    if differing:
        earlier = f" {EARLIER}" if made_earlier(found) else ""
        raise ValueError(
            f"{path} was made by another sweep: {differing}. Give another directory, or fly the "
            f"sweep that made it.{earlier}"
        )


EARLIER = (
    "An earlier jaxguide made it, which identified a sweep by the files of the package: it can be "
    "read (report, export, compare), but not continued or flown again."
)


def made_earlier(manifest: dict[str, Any]) -> bool:
    """Whether a manifest is of a jaxguide before programs were part of it."""
    return "programs" not in manifest


def differences(ours: dict[str, Any], theirs: dict[str, Any]) -> str:
    """The entries in which the manifest `theirs` differs from `ours`, by name, with both values; ""
    if there are none."""
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
