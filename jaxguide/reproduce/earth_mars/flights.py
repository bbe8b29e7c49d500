"""The six cases of Table 1: flown by every variant of the law at once, and re-optimised."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxguide.flight.integrators import RungeKutta4
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, Prepared, prepare, simulate
from jaxguide.laws.holds import History
from jaxguide.laws.neighboring import NeighboringOptimal, PreparedNeighboring
from jaxguide.neighboring.gains import GainSchedule
from jaxguide.nominal.shooting import Shooting
from jaxguide.problems.earth_mars import SAMPLE_INTERVAL, EarthMars
from jaxguide.reproduce.earth_mars.published import CASES
from jaxguide.solving import solve
from jaxguide.trajectory import Extremal

METHOD = Shooting(starts=8)  # one compiled program serves the nominal and the six re-solves
# The control turns by 20 rad/TU, that is 0.025 rad a step: its fourth power over 120 is 3e-9, of a
# control that moves the end by 0.1 LU.
INTEGRATOR = RungeKutta4(16)


def reoptimise(case: tuple[float, ...]) -> Extremal:
    """The extremal from a perturbed start, found afresh: no guess from the nominal."""
    start = tuple(a + b for a, b in zip(EarthMars.initial_state, case, strict=True))
    return solve(dataclasses.replace(EarthMars(), initial_state=start), METHOD)


def stage_times(times: np.ndarray) -> np.ndarray:
    """When the integrator asks for the control, within each sample."""
    return times[:, None] + SAMPLE_INTERVAL * np.asarray(INTEGRATOR.stages)[None, :]


def fly_cases(
    exact: GainSchedule, paper: GainSchedule, wrong: Float[np.ndarray, "sample stage m n"]
) -> dict[str, Flight]:
    """Variant -> the six flights of Table 1, batched. `wrong`: histories at the `stage_times`.

    The variants differ only in what is looked up at the integrator's stages, so one program flies
    them all, each on the history of a law prepared for it.
    """
    mission = _mission(exact)
    times, grid, of_exact = _prepare(mission)
    of_paper = _prepare(_mission(paper)).laws
    assert isinstance(of_exact, PreparedNeighboring) and isinstance(of_paper, PreparedNeighboring)
    constant = lambda a: jnp.broadcast_to(a[:, :1], a.shape)
    maps = lambda law, maps: dataclasses.replace(law, maps=maps, K=maps[:, 0])
    held = maps(of_paper, constant(of_paper.maps))
    variants = {
        "lstsq64_interp": of_paper,
        "lstsq64_zoh_du": held,
        "lstsq64_zoh_u": dataclasses.replace(held, u_nominal=constant(held.u_nominal)),
        "exact_interp": of_exact,
        "wrong sign": maps(of_paper, jnp.asarray(wrong)),
    }
    laws = jax.tree_util.tree_map(lambda *leaves: np.stack(leaves), *variants.values())
    flights = jax.device_get(_fly(mission, Prepared(times, grid, laws), jnp.asarray(CASES)))
    pick = lambda k: jax.tree_util.tree_map(lambda a: a[k], flights)
    return {name: pick(k) for k, name in enumerate(variants)}


def _mission(schedule: GainSchedule) -> Mission:
    extremal = schedule.extremal
    law, start = NeighboringOptimal(schedule), extremal.x[0]
    return Mission(
        extremal.problem, law, start, SAMPLE_INTERVAL, hold=History(), integrator=INTEGRATOR
    )


_prepare = eqx.filter_jit(prepare)


@eqx.filter_jit
def _fly(mission: Mission, prepared: Prepared, deviations: Array) -> Flight:
    """Every variant with every deviation: one `vmap` over all, which traces half of what two do."""

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
    """Flown minus re-optimised final state, by case."""
    return np.asarray(flight.final_state) - np.stack([np.asarray(e.x[-1]) for e in reoptimised])
