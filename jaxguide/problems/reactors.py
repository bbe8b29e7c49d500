"""Chemical reactors and a tumour: controls with arcs at a bound and singular arcs.

Constants are those of each problem's `reference.source`.
"""

from typing import Any

import jax.numpy as jnp

from jaxguide.problem import Free, Problem
from jaxguide.problems.reference import Reference


class CatalystMixing(Problem):
    """The mixture of two catalysts along a unit reactor that yields the most product."""

    state_names = ("x1", "x2")
    control_names = ("u",)
    initial_state = (1.0, 0.0)
    control_bounds = (0.0, 1.0)
    reference = Reference(
        -0.0480556858608761, 1e-14, "independent, arcs as phases", "PSOPT catmix; COPS"
    )

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        forward = u[0] * (10 * x[1] - x[0])
        return jnp.stack([forward, -forward - (1 - u[0]) * x[1]])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf[0] + xf[1] - 1


class Jackson(Problem):
    """Jackson's catalyst problem over a reactor of length 4: the most of the third species."""

    state_names = ("a", "b", "c")
    control_names = ("u",)
    initial_state = (1.0, 0.0, 0.0)
    final_time = 4.0
    control_bounds = (0.0, 1.0)
    reference = Reference(
        -0.19181435632518, 1e-14, "independent, arcs as phases", "CTDirect.jl jackson",
        trap="published 0.192011 and unstructured collocation (0.1918165) overshoot",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        forward = u[0] * (x[0] - 10 * x[1])
        made = (1 - u[0]) * x[1]
        return jnp.stack([-forward, forward - made, made])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return -xf[2]


_CAPACITY = ((5.85 - 0.02) / 0.00873) ** 1.5  # volume at which p and q rest without treatment


class Tumour(Problem):
    """Anti-angiogenic treatment with a bounded total dose: the smallest final tumour.

    State: tumour volume p, its vascular capacity q [mm^3], dose given; control: dose rate;
    time in days.
    """

    growth: Any = 0.084
    state_names = ("p", "q", "dose")
    control_names = ("rate",)
    initial_state = (_CAPACITY / 2, _CAPACITY / 4, 0.0)
    final_time = Free(0.1, 10.0, 1.0)
    state_bounds = ((1.0, 1.0, 0.0), (_CAPACITY, _CAPACITY, 15.0))
    control_bounds = (0.0, 75.0)
    reference = Reference(
        7571.67, 3e-4, "independent, two meshes", "Ledzewicz & Schaettler; Betts; pycollo",
        trap="three published values disagree in digit 7",
    )  # fmt: skip

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        p, q = x[0], x[1]
        supply = 5.85 - (0.02 + 0.00873 * p ** (2 / 3) + 0.15 * u[0])
        return jnp.stack([-self.growth * p * jnp.log(p / q), q * supply, u[0]])

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return xf[0]
