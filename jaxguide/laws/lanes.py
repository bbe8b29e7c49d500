"""What makes a batch of flights fast: vectors as tuples of scalars, laws prepared on a grid."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

# A vector as a tuple of scalars: under `vmap` each becomes one contiguous array of flights, which
# is what makes a batch of flights fast on a CPU.
Lanes = tuple[Any, ...]


def lanes(vector: Float[Array, " k"]) -> Lanes:
    """The entries of `vector`, as a tuple."""
    return tuple(vector[i] for i in range(vector.shape[0]))


class SampleGrid(eqx.Module):
    """Where a fixed-step flight will ask: sample times and the stage times within each sample."""

    times: Float[Array, " sample"]
    stages: Float[Array, "sample stage"]
