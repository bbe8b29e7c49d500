"""Moon lander: the best places of a fixed mesh's breaks for a control that switches."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from jaxguide.host.compilation import quick_compilation
from jaxguide.nominal.direct.pseudospectral import Pseudospectral
from jaxguide.problems.vehicles import MoonLander
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal
from jaxguide.tuning.meshes import mesh_error
from jaxguide.tuning.ready import Confirmed, Ready
from jaxguide.tuning.record import Tuned
from jaxguide.tuning.variables import Ascending

# Coarse, so that the places of the breaks matter; 1e-10, as gradients are of the converged solve.
METHOD = Pseudospectral(nodes=3, tolerance=1e-10, refinements=0)


def design(segments: int = 4, steps: int = 200) -> Ready:
    """Breaks of a mesh of `segments` segments of three nodes with the least `mesh_error`, starting
    from even ones.

    Each gradient goes through the converged direct solve by the implicit function theorem. The
    switch is known in closed form (`switch`) but is not used to find the breaks.

    **Arguments:** `steps`: of the optimiser.

    **Raises:** `ValueError` for fewer than two segments, which leave no break to move.
    """
    if segments < 2:
        raise ValueError(f"design: segments is {segments}; give at least 2.")

    def objective(extremal: Extremal, keys: Array) -> tuple[Array, dict[str, Array]]:
        return mesh_error(extremal), {"objective": extremal.objective}

    return Ready(
        name="moon-lander",
        about=f"breaks of a mesh of {segments} segments, for a control that switches",
        objective=objective,
        design={"breaks": Ascending(np.linspace(0.0, 1.0, segments + 1))},
        build=_build,
        optimizer=optax.adam(optax.cosine_decay_schedule(0.1, steps)),
        steps=steps,
        cases=1,
        confirm=_confirm,
        places=lambda own: {"breaks": own["breaks"]},
        compiler_options=quick_compilation(),
    )


def _build(own: dict[str, Any]) -> Extremal:
    method = dataclasses.replace(METHOD, fractions=own["breaks"])
    return solve(MoonLander(), method, throw=False)


def switch() -> tuple[float, float]:
    """Times at which full thrust begins and at which the lander rests on the ground.

    In closed form: after a free fall of t, full thrust must stop the speed within the remaining
    height.
    """
    lander = MoonLander()
    g, most = float(np.asarray(lander.gravity)), lander.control_bounds[1]
    (h, v), a = lander.initial_state, float(np.asarray(most)) - g
    # (v - g t)^2 = 2 a (h + v t - g t^2/2)
    p, q, r = g * g + a * g, -2 * v * (g + a), v * v - 2 * a * h
    t = (-q + math.sqrt(q * q - 4 * p * r)) / (2 * p)
    return t, t + (g * t - v) / a


def _confirm(tuned: Tuned, cases: int, seed: int) -> Confirmed:
    at, _ = switch()
    best = MoonLander.reference.value
    columns = []
    for own in (tuned.start, tuned.design):
        extremal = _build(jax.tree_util.tree_map(jnp.asarray, own))
        nearest = float(np.min(np.abs(np.asarray(extremal.breaks) - at)))
        off = abs(float(extremal.objective) / best - 1)
        columns.append((float(mesh_error(extremal)), off, nearest))
    names = ("mesh error", "objective, relative error", "nearest break to the switch, off by")
    rows = {name: (columns[0][i], columns[1][i]) for i, name in enumerate(names)}
    notes = (f"the control switches at t = {at:.9g}, known in closed form",)
    return Confirmed(rows, {}, notes, columns[1][0] < columns[0][0])
