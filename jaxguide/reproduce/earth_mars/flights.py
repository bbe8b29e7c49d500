"""The six cases of Table 1: flown by every variant of the law at once, and re-optimised."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.flight.integrators import Adaptive
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight, simulate
from jaxguide.laws.holds import Hold
from jaxguide.laws.law import Command, Law
from jaxguide.neighboring.gains import GainSchedule
from jaxguide.nominal.shooting import Shooting
from jaxguide.problems.earth_mars import SAMPLE_INTERVAL, EarthMars
from jaxguide.reproduce.earth_mars.collocation import at
from jaxguide.reproduce.earth_mars.published import CASES
from jaxguide.solving import solve
from jaxguide.spectral import interpolate, nodes_lgl
from jaxguide.trajectory import Extremal
from jaxguide.types import RESULTS

METHOD = Shooting(starts=8)  # one compiled program serves the nominal and the six re-solves
TABLE_NODES = 12  # points a sample at which histories are tabulated: see `Tabulated`


class Table(NamedTuple):
    """A neighbouring-optimal law at points of every sample; leaves have a leading sample axis."""

    x: Float[Array, "*k n"]  # nominal, at the sample
    u: Float[Array, "*k stage m"]  # nominal
    maps: Float[Array, "*k stage m n"]  # du per deviation at the sample, eq. (49)


class Tabulated(Law):
    """`NeighboringOptimal`, looked up in a Table.

    All variants then share one small program, which adaptive flights interpolate. The control's
    nearest singularity is some 0.05 TU from the real axis, so that twelve Legendre points on a
    sample of 0.02 TU leave 1e-12.
    """

    table: Table
    nodes: Float[Array, " stage"]
    interval: Float[Array, ""]

    def start(self, x0: Array) -> None:
        return None

    def __call__(self, t_k: Any, x: Array, memory: None) -> tuple["TabulatedCommand", None]:
        k = jnp.round(t_k / self.interval).astype(int)
        one = jax.tree_util.tree_map(lambda a: a[k], self.table)
        command = TabulatedCommand(
            law=self,
            one=one,
            t_k=t_k,
            dx=x - one.x,
            result=RESULTS.successful,
            saturated=jnp.array(False),
        )
        return command, None


class TabulatedCommand(Command):
    """What `Tabulated` orders from `t_k` on."""

    law: Tabulated
    one: Table
    t_k: Float[Array, ""]
    dx: Float[Array, " n"]
    result: RESULTS
    saturated: Bool[Array, ""]

    def _look_up(self, table: Array, t: Any) -> Array:
        return interpolate(self.law.nodes, table, 2 * (t - self.t_k) / self.law.interval - 1)

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self._look_up(self.one.u, t)

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self._look_up(self.one.maps, t) @ self.dx


class Clocked(Hold):
    """History (kind 0), HoldDeviation (1) or HoldControl (2); `kind` may be traced, so that one
    program flies all three."""

    kind: Array

    def __call__(self, command: Command, t_k: Any) -> "ClockedCommand":
        return ClockedCommand(
            command=command,
            t_k=t_k,
            kind=self.kind,
            result=command.result,
            saturated=command.saturated,
        )


class ClockedCommand(Command):
    """What is held is asked at the sample's time, what is not at its own."""

    command: Command
    t_k: Float[Array, ""]
    kind: Array
    result: RESULTS
    saturated: Bool[Array, ""]

    def nominal(self, t: Any) -> Float[Array, " m"]:
        return self.command.nominal(jnp.where(self.kind == 2, self.t_k, t))

    def deviation(self, t: Any) -> Float[Array, " m"]:
        return self.command.deviation(jnp.where(self.kind == 0, t, self.t_k))


def reoptimise(case: tuple[float, ...]) -> Extremal:
    """The extremal from a perturbed start, found afresh: no guess from the nominal."""
    start = tuple(a + b for a, b in zip(EarthMars.initial_state, case, strict=True))
    return solve(dataclasses.replace(EarthMars(), initial_state=start), METHOD)


def fly_cases(
    extremal: Extremal,
    exact: GainSchedule,
    paper: GainSchedule,
    wrong: np.ndarray,
    instants: np.ndarray,
) -> dict[str, Flight]:
    """Variant -> the six flights of Table 1, batched. `wrong`: histories at the `instants`."""
    u = at(extremal, instants.reshape(-1))[0].u.reshape(*instants.shape, -1)
    x = at(extremal, instants[:, 0])[0].x
    of_paper, of_exact = (np.asarray(_histories(s, jnp.asarray(instants))) for s in (paper, exact))
    variants = {
        "lstsq64_interp": (of_paper, 0),
        "lstsq64_zoh_du": (of_paper, 1),
        "lstsq64_zoh_u": (of_paper, 2),
        "exact_interp": (of_exact, 0),
        "wrong sign": (wrong, 0),
    }
    maps = jnp.asarray(np.stack([maps for maps, _ in variants.values()]))
    kinds = jnp.asarray([kind for _, kind in variants.values()])
    table = Table(jnp.asarray(x), jnp.asarray(u), maps[0])
    nodes = jnp.asarray(nodes_lgl(TABLE_NODES)[0])
    mission = Mission(
        extremal.problem,
        Tabulated(table, nodes, jnp.asarray(SAMPLE_INTERVAL)),
        extremal.x[0],
        SAMPLE_INTERVAL,
        hold=Clocked(kinds[0]),
        integrator=Adaptive(1e-11),
    )
    flights = jax.device_get(_fly(mission, maps, kinds, jnp.asarray(CASES)))
    pick = lambda k: jax.tree_util.tree_map(lambda a: a[k], flights)
    return {name: pick(k) for k, name in enumerate(variants)}


@eqx.filter_jit
def _histories(schedule: GainSchedule, instants: Array) -> Float[Array, "sample instant m n"]:
    within = jax.vmap(schedule.history, in_axes=(None, 0))
    return jax.vmap(within)(schedule.times, instants)


@eqx.filter_jit
def _fly(mission: Mission, maps: Array, kinds: Array, deviations: Array) -> Flight:
    """Every variant with every deviation: one `vmap` over all, which traces half of what two do."""

    def one(maps: Array, kind: Array, dx: Array) -> Flight:
        where = lambda m: (m.law.table.maps, m.hold.kind, m.initial_state)
        return simulate(eqx.tree_at(where, mission, (maps, kind, mission.initial_state + dx)))

    variants, cases = maps.shape[0], deviations.shape[0]
    each = lambda a: jnp.repeat(a, cases, axis=0)
    flights = jax.vmap(one)(each(maps), each(kinds), jnp.tile(deviations, (variants, 1)))
    split = lambda a: a.reshape(variants, cases, *a.shape[1:])
    return jax.tree_util.tree_map(split, flights)


def final_errors(flight: Flight, reoptimised: list[Extremal]) -> np.ndarray:
    """Flown minus re-optimised final state, by case."""
    return np.asarray(flight.final_state) - np.stack([np.asarray(e.x[-1]) for e in reoptimised])
