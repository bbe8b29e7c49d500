"""The ascent of a Delta III to its transfer orbit in four stages."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxguide.problem import Free, Problem
from jaxguide.problems.reference import Reference
from jaxguide.transforms.phased import Phased, PhaseEnds

# Numbers of Benson (2005), section 9.1, and Rao et al. (2010), section 6.3: see `DeltaIII`.
_RADIUS, _GRAVITY = 6_378_145.0, 3.986012e14  # of the Earth: m, m^3/s^2
_ROTATION = 7.29211585e-5  # rad/s
_SCALE_HEIGHT = 7200.0  # of the air, m
_DRAG_AREA = 0.5 * 4 * np.pi  # drag coefficient times area, m^2
_LATITUDE = np.deg2rad(28.5)  # of the pad

# Mass and propellant [kg], thrust [N], burning time [s] of a solid booster and both stages.
_BOOSTER, _FIRST, _SECOND = (
    (19_290.0, 17_010.0, 628_500.0, 75.2),
    (104_380.0, 95_550.0, 1_083_100.0, 261.0),
    (19_300.0, 16_820.0, 110_094.0, 700.0),
)
_PAYLOAD = 4164.0  # kg
# Semi-major axis [m], eccentricity, inclination, node and perigee [rad] of the orbit.
_ORBIT = (24_361_140.0, 0.7308, *np.deg2rad([28.5, 269.8, 130.5]))


class Stage(Problem):
    """One phase of the ascent, until `final_time` [s].

    State: position and velocity in inertial axes at the Earth's centre [m, m/s], mass [kg]. The
    control is the direction of the thrust, a vector of length 1 at most; at the optimum it is 1.
    """

    thrust: ArrayLike = 0.0  # N
    flow: ArrayLike = 0.0  # kg/s
    density: ArrayLike = 1.225  # of the air on the ground, kg/m^3
    final_time: Any = 0.0
    initial_state: Any = Free()
    state_names = ("x", "y", "z", "vx", "vy", "vz", "m")
    control_names = ("ux", "uy", "uz")
    control_bounds = (-3.0, 3.0)  # never active: the path constraint limits the control to 1
    path_bounds = (-jnp.inf, 1.0)

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        r, v, m = x[:3], x[3:6], x[6]
        distance = jnp.sqrt(r @ r)
        wind = jnp.stack([-r[1], r[0], jnp.zeros_like(m)]) * _ROTATION
        through = v - wind
        speed = jnp.sqrt(through @ through + 1e-6)  # 1 mm/s: smooth at the start, where it is 0
        altitude = jnp.maximum(distance - _RADIUS, 0.0)  # guesses may pass below the ground
        density = self.density * jnp.exp(-altitude / _SCALE_HEIGHT)
        drag = -0.5 * density * _DRAG_AREA * speed * through
        rate = (self.thrust * u + drag) / m - _GRAVITY * r / distance**3
        return jnp.concatenate([v, rate, -jnp.asarray(self.flow, m.dtype)[None]])

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return (u @ u)[None]


class Injection(Stage):
    """The last phase: into the target orbit with the most mass left."""

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        return -xf[6]

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        # The angular momentum, and the eccentricity vector's two components in the plane of the
        # orbit: five conditions, smooth also where orbital elements are not.
        momentum, perigee, across = orbit()
        r, v = xf[:3], xf[3:6]
        h = jnp.cross(r, v)
        e = jnp.cross(v, h) / _GRAVITY - r / jnp.sqrt(r @ r)
        size = np.linalg.norm(momentum)
        return jnp.concatenate(
            [(h - momentum) / size, jnp.stack([e @ perigee - _ORBIT[1], e @ across])]
        )


def orbit() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The target orbit: angular momentum [m^2/s], unit vector to the perigee, unit vector in the
    plane across to it."""
    a, e, i, node, argument = _ORBIT
    turn = lambda angle: np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    tilt = np.array([[1, 0, 0], [0, np.cos(i), -np.sin(i)], [0, np.sin(i), np.cos(i)]])
    frame = turn(node) @ tilt @ turn(argument)
    return np.sqrt(_GRAVITY * a * (1 - e * e)) * frame[:, 2], frame[:, 0], frame[:, 1]


def staging(ends: tuple[PhaseEnds, ...]) -> Any:
    """Links of the phases: position and velocity are continuous, and the mass drops by the empty
    boosters and the empty first stage."""
    dry = lambda part, count: count * (part[0] - part[1])
    dropped = (dry(_BOOSTER, 6), dry(_BOOSTER, 3), dry(_FIRST, 1))
    return jnp.concatenate(
        [
            b.x0 - a.xf.at[6].add(-mass)
            for a, b, mass in zip(ends[:-1], ends[1:], dropped, strict=True)
        ]
    )


class DeltaIII(Phased):
    """The most mass in a transfer orbit by a Delta III, in four phases.

    The first stage burns with six boosters, with three, and alone; then the second stage. After
    each phase but the last the empty parts are dropped.

    **Source:** D. A. Benson, *A Gauss Pseudospectral Transcription for Optimal Control*, MIT, 2005,
    section 9.1; with the numbers of Rao et al., ACM TOMS 37 (2010), section 6.3, and of Betts,
    *Practical Methods for Optimal Control* (2010), section 6.15.
    """

    reference = Reference(
        -7529.712287, 2e-6, "another pseudospectral code", "Rao et al. (2010), section 6.3"
    )

    def __init__(self, phases: Any = None, links: Any = staging):
        super().__init__(stages() if phases is None else phases, links)


def _box(heaviest: float) -> tuple:
    """State bounds far from active, from which the solver takes its units."""
    high = (*(2 * _RADIUS,) * 3, *(1.2e4,) * 3, 1.05 * heaviest)
    return (*(-v for v in high[:6]), 1e3), high


def stages(density: float = 1.225) -> tuple[Stage, ...]:
    """The four phases; `density` [kg/m^3]: of the air on the ground."""
    rate = lambda part: part[1] / part[3]
    on_pad = _PAYLOAD + _SECOND[0] + _FIRST[0] + 9 * _BOOSTER[0]
    start = _RADIUS * np.array([np.cos(_LATITUDE), 0.0, np.sin(_LATITUDE)])
    with_earth = np.array([0.0, start[0] * _ROTATION, 0.0])
    burning = lambda boosters: {
        "thrust": _FIRST[2] + boosters * _BOOSTER[2],
        "flow": rate(_FIRST) + boosters * rate(_BOOSTER),
        "density": density,
    }
    once = _BOOSTER[3]
    unknown, dry = (Free(),) * 6, _PAYLOAD + _SECOND[0]
    second = on_pad - 6 * _BOOSTER[0] - once * rate(_FIRST)
    third = dry + _FIRST[0] - 2 * once * rate(_FIRST)
    free = lambda mass: (*unknown, Free(guess=mass))
    return (
        Stage(
            **burning(6), final_time=once, initial_state=(*start, *with_earth, on_pad),
            state_bounds=_box(on_pad),
        ),
        Stage(
            **burning(3), final_time=2 * once, initial_state=free(second),
            state_bounds=_box(second),
        ),
        Stage(
            **burning(0), final_time=_FIRST[3], initial_state=free(third),
            state_bounds=_box(third),
        ),
        Injection(
            thrust=_SECOND[2], flow=rate(_SECOND), density=density, initial_state=free(dry),
            state_bounds=_box(dry), final_time=Free(_FIRST[3] + 1.0, _FIRST[3] + _SECOND[3], 900.0),
        ),
    )  # fmt: skip
