"""Controls of a direct solution where nothing holds them: from H_u = 0. Host only."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxguide.problem.points import control_curvature, slopes
from jaxguide.trajectory import Extremal

# The longest step, as a share of the control's size: beyond an interpolation's error and short of
# another branch of H_u = 0. Chosen, not tuned.
_NEAR = 1e-3


def with_stationary_controls(extremal: Extremal) -> Extremal:
    """`extremal`, of a problem without bounds or path constraints, its controls moved by one Newton
    step on H_u = 0 at its states and costates: 2002 paper, eq. (7). Nodes of the quadrature hardly
    move; at the ends of segments that are none the control was extrapolated.

    **Error:** the square of what the control was wrong by.
    """
    e = jax.device_get(extremal)
    ends = slice(e.degree, None, e.degree)
    u: Any = _moved(e, e.t, e.x, e.u, e.costate)
    if e.u_before is None or e.costate_before is None:
        return dataclasses.replace(e, u=u)
    before: Any = _moved(e, e.t[ends], e.x[ends], e.u_before, e.costate_before)
    return dataclasses.replace(e, u=u, u_before=before)


def _moved(
    extremal: Extremal, t: Any, x: Any, u: Any, costate: Any
) -> Float[np.ndarray, "point m"]:
    problem, n, m = extremal.stated, x.shape[1], u.shape[1]
    at: Any = slopes(problem, t, x, u)
    h_u = at.cost_by[:, n : n + m] + (costate[:, None] @ at.f_by)[:, 0, n : n + m]
    h_uu: Any = control_curvature(problem, t, x, u, costate)
    regular = np.linalg.cond(np.where(np.isfinite(h_uu), h_uu, 0.0)) < 1 / np.finfo(float).eps
    step = np.linalg.solve(np.where(regular[:, None, None], h_uu, np.eye(m)), h_u[..., None])[
        ..., 0
    ]
    size = np.max(np.abs(extremal.u), axis=0)
    small = regular & np.all(np.abs(step) <= _NEAR * size[None], axis=1)
    return np.where(small[:, None], u - step, u)
