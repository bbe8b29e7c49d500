"""The next mesh: where its breaks go, how many nodes it has, and what the last one left open."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxguide.arrays import Array, xp
from jaxguide.nominal.direct.unknowns import Arcwise
from jaxguide.spectral.either import to_legendre
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS

# How strongly breaks follow the error, and the share that smooth segments keep of the worst one's:
# first choices, tried on five problems of the library and not tuned.
_POWER, _FLOOR = 1 / 3, 0.03
_NEAR = 0.25  # of the distance between two breaks: nearer, one of them serves. A choice.


class MeshStep(NamedTuple):
    """One solve of the refinement, for `watch`: what was tried, and how good it is.

    `error`: the largest defect between nodes, relative to the states' span (`segment_errors`).
    """

    step: str
    extremal: Extremal
    error: float

    def __str__(self) -> str:
        e = self.extremal
        reason = RESULTS[e.result] or "converged"
        return (
            f"{self.step}: {len(e.breaks) - 1} segments of degree {e.degree}, "
            f"objective {float(e.objective):.12g}, defect between nodes {self.error:.1e}, {reason}"
        )


def tails(extremal: Extremal) -> Float[Array, ""]:
    """Largest of the last two Legendre coefficients of state and costate, relative to their size:
    by Jackson's theorem (review, section 4.4) what a finer grid could still change."""
    last = to_legendre(extremal.reference_nodes)[-2:]
    parts = (extremal.by_segment(extremal.x), extremal.costate_by_segment())
    size = extremal.sizes()
    tails = [
        xp.max(xp.abs(last @ v) / of[None, None])
        for v, of in zip(parts, (size.x, size.costate), strict=True)
    ]
    return xp.maximum(*tails)


def moved(
    fractions: Float[np.ndarray, " edge"],
    errors: Float[np.ndarray, " segment"],
    segments: int,
    fixed: "Float[np.ndarray, ' mark'] | None" = None,
) -> Float[np.ndarray, " new_edge"]:
    """Breaks of `segments` segments that share the errors more equally. Those at `fixed` fractions
    stay, with at least one segment between each two."""
    share = np.maximum((errors / errors.max()) ** _POWER, _FLOOR)
    total = np.concatenate([[0.0], np.cumsum(share)])
    inner = np.zeros(0) if fixed is None else fixed
    ends = np.concatenate([[0.0], inner, [1.0]])
    at = np.interp(ends, fractions, total)
    weight = np.diff(at) / total[-1]
    counts = np.ones(len(weight), int)
    for _ in range(segments - len(weight)):
        counts[np.argmax(weight / counts)] += 1
    parts = [
        np.interp(np.linspace(a, b, k + 1)[:-1], total, fractions)
        for a, b, k in zip(at[:-1], at[1:], counts, strict=True)
    ]
    new = np.concatenate([*parts, [1.0]])
    new[np.concatenate([[0], np.cumsum(counts)])] = ends
    return new


def united(
    fractions: Float[np.ndarray, " edge"], marks: Float[np.ndarray, " mark"]
) -> Float[np.ndarray, " new_edge"]:
    """`fractions` with breaks at the `marks` too; inner breaks that one of these comes near, by a
    part of the distance to their neighbours, make room."""
    if not len(marks):
        return fractions
    room = _NEAR * np.minimum(np.diff(fractions[:-1]), np.diff(fractions[1:]))
    inner = fractions[1:-1]
    far = np.min(np.abs(inner[:, None] - marks[None]), axis=1, initial=np.inf) > room
    return np.sort(np.concatenate([fractions[:1], inner[far], marks, fractions[-1:]]))


def split(
    fractions: Float[np.ndarray, " edge"], which: Bool[np.ndarray, " segment"]
) -> Float[np.ndarray, " new_edge"]:
    """`fractions` with the segments `which` halved."""
    middle = (fractions[1:] + fractions[:-1])[which] / 2
    return np.sort(np.concatenate([fractions, middle]))


def fractions_of(extremal: Extremal) -> Float[np.ndarray, " edge"]:
    """Its breaks as fractions of the horizon."""
    breaks = np.asarray(extremal.breaks)
    return (breaks - breaks[0]) / (breaks[-1] - breaks[0])


def remeshed(
    method: Any,
    fractions: Float[np.ndarray, " edge"],
    nodes: int,
    knots: tuple[int, ...] = (),
    arcwise: Arcwise | None = None,
) -> Any:
    """`method` on another mesh, from one start."""
    changed: dict[str, Any] = {"nodes": nodes, "segments": len(fractions) - 1, "starts": 1}
    return dataclasses.replace(method, fractions=fractions, knots=knots, arcwise=arcwise, **changed)
