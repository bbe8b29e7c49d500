"""What a tuning run leaves: the design found and how it got there. Host only."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxguide.tuning.designs import values

HISTORY = "history.npz"


class Tuned(NamedTuple):
    """Outcome of `jg.tune`.

    - `design`: the best seen, as `build` takes it; `raw`: the same as the optimiser has it, to go
      on from. `start`: the design at the start.
    - `loss`: of the best; `at`: its step. Where a temperature falls, the best at its lowest.
    - `history`: by step: `loss`, `gradient_norm`, `temperature` if there is one, `term:NAME` of
      what else the objective returned, `design:PATH` of every leaf.
    - `stopped`: "steps", "tolerance" or "not finite"; `message`: the same in words.
    - `compile_s`, `step_s`: seconds to compile, and of a warm step.
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


class History:
    """Rows of a run as they come, written to `folder` now and then.

    A file is replaced by a whole one, so that a killed run leaves the last.
    """

    def __init__(self, folder: Path | None):
        self.folder, self.rows = folder, []
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def add(self, row: dict[str, Any]) -> None:
        self.rows.append({name: np.asarray(value) for name, value in row.items()})

    def columns(self) -> dict[str, np.ndarray]:
        names = self.rows[0] if self.rows else {}
        return {name: np.stack([row[name] for row in self.rows]) for name in names}

    def write(self) -> None:
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
    """`Tuned.history` as saved by `jg.tune(..., out=folder)`; nothing in the file is executed.

    **Raises:** `ValueError` where there is none.
    """
    path = Path(folder) / HISTORY
    if not path.is_file():
        raise ValueError(f"{path} is not there; jg.tune(..., out=folder) writes it.")
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def on_host(design: Any) -> Any:
    """Values of a design, off the device."""
    import jax

    return jax.tree_util.tree_map(np.asarray, jax.device_get(values(design)))
