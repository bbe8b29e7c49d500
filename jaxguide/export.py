"""A stored sweep in other formats: CSV, JSON, Parquet, netCDF. Host only.

Cases are read and written a block at a time, so that any number fits in memory. The file gets its
name when it is complete.
"""

import csv
import importlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from jaxguide.sweeping import store as stores
from jaxguide.types import message

_BLOCK = 65_536  # cases read at once: some megabytes


def export(store: Any, out: Any) -> Path:
    """Writes the cases of the sweep stored at `store` to `out`; its ending chooses the format.

    - `.csv`: a line for each case, a column for each number, results by name; numbers read back to
      the same bits.
    - `.json`: one object: `sweep`, `about`, `summary`, and `cases`, a list for each column.
    - `.parquet` (needs pyarrow): the same columns; the rest as JSON in the schema's metadata.
    - `.nc` (needs h5netcdf): the Dataset with its dimensions and flights in full; its attributes
      that are not numbers as JSON text.

    **Raises:** `ValueError` if there is no sweep, or for another ending; `RuntimeError` without the
    library that a format needs; `OSError` if nothing can be written.
    """
    store, out = Path(store), Path(out)
    writer = _WRITERS.get(out.suffix)
    if writer is None:
        raise ValueError(
            f"export: {out.name!r} ends in {out.suffix!r}; choose one of {', '.join(_WRITERS)}."
        )
    attributes = stores.attributes_of(store)
    out.parent.mkdir(parents=True, exist_ok=True)
    beside = out.with_name(f".{out.name}.partial{out.suffix}")
    try:
        writer(store, attributes, beside)
        os.replace(beside, out)
    finally:
        beside.unlink(missing_ok=True)
    return out


def columns(data: Any) -> dict[str, Callable[[slice], np.ndarray]]:
    """Column -> function that reads a block of it, for every number of a case."""
    states = [str(s) for s in data["state"].values]
    found: dict[str, Callable[[slice], np.ndarray]] = {
        "case": lambda rows: data["case"].values[rows]
    }
    for name in sorted(str(n) for n in data.data_vars if data[n].dims[:1] == ("case",)):
        array = data[name]
        width = int(np.prod(array.shape[1:]))
        whole = lambda rows, array=array: array[rows].values.reshape(rows.stop - rows.start, -1)
        if array.ndim == 1:
            found[name] = lambda rows, whole=whole: whole(rows)[:, 0]
            continue
        labels = states if "state" in array.dims or width == len(states) else range(width)
        for j, at in enumerate(labels):
            found[f"{name}[{at}]"] = lambda rows, whole=whole, j=j: whole(rows)[:, j]
    return found


def _blocks(data: Any) -> Iterator[slice]:
    cases = data.sizes["case"]
    return (slice(a, min(a + _BLOCK, cases)) for a in range(0, cases, _BLOCK))


def _named(name: str, values: np.ndarray) -> Any:
    return [message(int(v)) for v in values] if name == "result" else values.tolist()


def _csv(store: Path, attributes: dict[str, Any], out: Path) -> None:
    data = stores.open_store(store)
    found = columns(data)
    with out.open("w", newline="", encoding="utf-8") as stream:
        lines = csv.writer(stream)
        lines.writerow(found)
        for rows in _blocks(data):
            # Python's repr of a float reads back to its bits.
            read = [_named(name, column(rows)) for name, column in found.items()]
            lines.writerows(zip(*read, strict=True))


def _json(store: Path, attributes: dict[str, Any], out: Path) -> None:
    data = stores.open_store(store)
    with out.open("w", encoding="utf-8") as stream:
        stream.write("{")
        for name in ("sweep", "about", "summary"):
            stream.write(f"{json.dumps(name)}: {json.dumps(attributes.get(name))},\n")
        stream.write('"cases": {')
        for i, (name, column) in enumerate(columns(data).items()):
            stream.write(f"{',' if i else ''}\n{json.dumps(name)}: [")
            _json_list(stream, (_named(name, column(rows)) for rows in _blocks(data)))
            stream.write("]")
        stream.write("}}\n")


def _json_list(stream: TextIO, blocks: Iterator[list]) -> None:
    for i, values in enumerate(blocks):
        text = json.dumps(stores.plain(values))[1:-1]
        stream.write(f"{', ' if i and text else ''}{text}")


def _optional(module: str, form: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as e:
        raise RuntimeError(
            f"export to {form} needs {module}; install it with pip install 'jaxguide[export]'."
        ) from e


def _parquet(store: Path, attributes: dict[str, Any], out: Path) -> None:
    pa, parquet = _optional("pyarrow", "Parquet"), _optional("pyarrow.parquet", "Parquet")
    data = stores.open_store(store)
    found = columns(data)
    rest = {k: json.dumps(attributes.get(k)) for k in ("sweep", "about", "summary")}
    writer = None
    try:
        for rows in _blocks(data):
            read = {
                name: _named(name, column(rows)) if name == "result" else column(rows)
                for name, column in found.items()
            }
            table = pa.table(read)
            if writer is None:
                schema = table.schema.with_metadata(rest)
                writer = parquet.ParquetWriter(out, schema)
            writer.write_table(table.replace_schema_metadata(rest))
    finally:
        if writer is not None:
            writer.close()


def _netcdf(store: Path, attributes: dict[str, Any], out: Path) -> None:
    _optional("h5netcdf", "netCDF")
    data = stores.open_store(store)
    text = {k: json.dumps(stores.plain(v)) for k, v in data.attrs.items()}
    data = data.assign_attrs(text).assign_coords(
        state=[str(s) for s in data["state"].values],
    )
    # Dask reads and writes a chunk at a time.
    data.chunk({"case": _BLOCK}).to_netcdf(out, engine="h5netcdf")


_WRITERS = {".csv": _csv, ".json": _json, ".parquet": _parquet, ".nc": _netcdf}
