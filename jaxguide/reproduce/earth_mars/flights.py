"""The six cases of the 2002 paper, Table 1: flown by every variant of the law, and re-optimised."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.flight.integrators import RungeKutta4
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, Prepared, simulate
from jaxguide.host.compilation import kept_hastily, kept_quickly
from jaxguide.laws.holds import History
from jaxguide.laws.lanes import SampleGrid
from jaxguide.laws.neighboring import NeighboringOptimal, PreparedNeighboring
from jaxguide.neighboring.gains import GainSchedule
from jaxguide.nominal.indirect.shooting import Shooting
from jaxguide.problems.earth_mars import SAMPLE_INTERVAL, EarthMars
from jaxguide.reproduce.earth_mars.collocation import linearized_at
from jaxguide.reproduce.earth_mars.published import CASES
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal

# One compiled program serves the nominal and the six re-solves. 4 starts, by experiment: each of
# the seven finds its extremal.
METHOD = Shooting(starts=4)
# The control turns by 20 rad/TU, that is 0.025 rad a step: its fourth power over 120 is 3e-9, of a
# control that moves the end by 0.1 LU.
INTEGRATOR = RungeKutta4(16)


def reoptimise(case: tuple[float, ...]) -> Extremal:
    """The extremal from the nominal start plus `case` (LU, LU/TU), solved without a guess."""
    # Arrays, so that the programs take them: as numbers they would be a part of each.
    start = tuple(np.float64(a + b) for a, b in zip(EarthMars.initial_state, case, strict=True))
    return solve(dataclasses.replace(EarthMars(), initial_state=start), METHOD)


def stage_times(times: np.ndarray) -> Float[np.ndarray, "sample stage"]:
    """Times [TU] at which the integrator asks for the control, sample by sample."""
    return times[:, None] + SAMPLE_INTERVAL * np.asarray(INTEGRATOR.stages)[None, :]


@kept_quickly
def histories(
    schedule: GainSchedule, instants: Float[Array | np.ndarray, "sample stage"]
) -> Float[Array, "sample stage m n"]:
    """The schedule's open-loop control at the `instants`, per deviation at the sample's start."""
    # One `vmap` over all: two, nested, take twice as long to trace.
    samples = jnp.repeat(instants[:, 0], instants.shape[1])
    found = jax.vmap(schedule.history)(samples, instants.reshape(-1))
    return found.reshape(*instants.shape, *found.shape[1:])


def fly_variants(
    schedule: GainSchedule,
    instants: Float[np.ndarray, "sample stage"],
    of_exact: Float[Array, "sample stage m n"],
    of_paper: Float[Array, "sample stage m n"],
    wrong: Float[np.ndarray, "sample stage m n"],
) -> dict[str, Flight]:
    """The six flights of Table 1 by variant of the law, batched, from control histories at the
    `stage_times`.

    The variants differ only in the numbers looked up at the integrator's stages, so one program
    flies all of them; each has its whole history prepared beforehand.
    """
    extremal = schedule.extremal
    law, start = NeighboringOptimal(schedule), extremal.x[0]
    mission = Mission(
        extremal.problem, law, start, SAMPLE_INTERVAL, hold=History(), integrator=INTEGRATOR
    )
    samples, stages = instants.shape
    points, _ = linearized_at(extremal, instants.reshape(-1))
    x, u = (a.reshape(samples, stages, -1) for a in points[:2])
    exact, paper = np.asarray(of_exact), np.asarray(of_paper)
    held = lambda a: np.broadcast_to(a[:, :1], a.shape)
    variants = {  # nominal and deviation at the stages
        "lstsq64_interp": (u, paper),
        "lstsq64_zoh_du": (u, held(paper)),
        "lstsq64_zoh_u": (held(u), held(paper)),
        "exact_interp": (u, exact),
        "wrong sign": (u, wrong),
    }
    inside, cap = np.ones(samples, bool), np.full(samples, np.inf)
    leaves = [(x[:, 0], maps[:, 0], u, maps, cap, inside) for u, maps in variants.values()]
    stacked = [np.stack(a) for a in zip(*leaves, strict=True)]
    times = np.append(instants[:, 0], instants[-1, -1])
    host = (stacked, times, instants[:, 0], instants, np.asarray(CASES))
    stacked, times, begins, within, cases = jax.device_put(host)
    grid = SampleGrid(begins, within)
    flights = _fly(mission, Prepared(times, grid, PreparedNeighboring(*stacked)), cases)
    flights = jax.device_get(flights)
    pick = lambda k: jax.tree_util.tree_map(lambda a: a[k], flights)
    return {name: pick(k) for k, name in enumerate(variants)}


@kept_hastily
def _fly(mission: Mission, prepared: Prepared, deviations: Array) -> Flight:
    """Every variant with every deviation, in one `vmap`: two, nested, trace twice as much."""

    def one(law: PreparedNeighboring, dx: Array) -> Flight:
        start = mission.initial_state + dx
        flown = eqx.tree_at(lambda m: m.initial_state, mission, start)
        return simulate(flown, prepared=prepared._replace(laws=law))

    variants, cases = jax.tree_util.tree_leaves(prepared.laws)[0].shape[0], deviations.shape[0]
    laws = jax.tree_util.tree_map(lambda a: jnp.repeat(a, cases, axis=0), prepared.laws)
    flights = jax.vmap(one)(laws, jnp.tile(deviations, (variants, 1)))
    split = lambda a: a.reshape(variants, cases, *a.shape[1:])
    return jax.tree_util.tree_map(split, flights)


def final_errors(flight: Flight, reoptimised: list[Extremal]) -> np.ndarray:
    """Flown minus re-optimised final state, shape (case, n), in LU and LU/TU."""
    return np.asarray(flight.final_state) - np.stack([np.asarray(e.x)[-1] for e in reoptimised])
