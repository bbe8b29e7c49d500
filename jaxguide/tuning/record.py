"""The outcome of a tuning run and the record of its steps. Host only."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxguide.tuning.variables import values

HISTORY = "history.npz"  # the file in the folder of a run


class Tuned(NamedTuple):
    """Outcome of `jg.tune`.

    - `design`: the best design, as `build` takes it; `raw`: the same as the optimiser has it, from
      which another run can start. `start`: the design at the start.
    - `loss`: of the best design; `at`: its step. Where a temperature falls, the best is that at the
      lowest temperature.
    - `history`: arrays by step: `loss`, `gradient_norm`, `temperature` if there is one, `term:NAME`
      for every other value of the objective, `design:PATH` for every leaf.
    - `stopped`: "steps", "tolerance" or "not finite"; `message`: the reason as a sentence.
    - `compile_s`, `step_s`: seconds to compile, and of a compiled step.
    """

    design: Any
    raw: Any
    start: Any
    loss: float
    at: int
    history: dict[str, np.ndarray]
    stopped: str
    message: str
    compile_s: float
    step_s: float

    def __repr__(self) -> str:
        first = float(self.history["loss"][0])
        return (
            f"Tuned: loss {self.loss:.6g} at step {self.at} of {len(self.history['loss'])} "
            f"(from {first:.6g}); {self.message}"
        )


class Recorder:
    """Collects a row of numbers for each step of a run, and writes them to `folder`, if any.

    A file is replaced by a whole one, so that a killed run leaves the last that was written.
    """

    def __init__(self, folder: Path | None):
        self.folder, self.rows = folder, []
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def add(self, row: dict[str, Any]) -> None:
        """Adds the row of one step: column -> value."""
        self.rows.append({name: np.asarray(value) for name, value in row.items()})

    def columns(self) -> dict[str, np.ndarray]:
        """Column -> values (step, ...); those of the first row's names."""
        names = self.rows[0] if self.rows else {}
        return {name: np.stack([row[name] for row in self.rows]) for name in names}

    def write(self) -> None:
        """Replaces the file by one with all rows; nothing without a folder."""
        if self.folder is None:
            return
        final, part = self.folder / HISTORY, self.folder / f".{HISTORY}.{os.getpid()}"
        try:
            with part.open("wb") as file:
                np.savez(file, **self.columns())  # pyright: ignore[reportArgumentType]
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, final)
        finally:
            part.unlink(missing_ok=True)


def load_history(folder: Any) -> dict[str, np.ndarray]:
    """`Tuned.history` as written by `jg.tune(..., out=folder)`; no code in the file is executed.

    **Raises:** `ValueError` if there is no such file.
    """
    path = Path(folder) / HISTORY
    if not path.is_file():
        raise ValueError(f"{path} is not there; jg.tune(..., out=folder) writes it.")
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def on_host(design: Any) -> Any:
    """The values of `design`, `Bounded` and `Ascending` replaced by theirs, as NumPy arrays."""
    import jax

    return jax.tree_util.tree_map(np.asarray, jax.device_get(values(design)))
