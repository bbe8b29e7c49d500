"""Earth-Mars: the fewest samples, and where, that keep the 99th percentile of the miss."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxguide.flight.integrators import RungeKutta4
from jaxguide.flight.mission import Mission
from jaxguide.laws.holds import History, HoldDeviation
from jaxguide.laws.neighboring import NeighboringOptimal
from jaxguide.montecarlo.rollouts import case_key
from jaxguide.neighboring.gains import GainSchedule, gain_schedule
from jaxguide.problems.earth_mars import CAP, SAMPLE_INTERVAL, EarthMars, dispersions, mission
from jaxguide.solving import solve
from jaxguide.trajectory import Extremal
from jaxguide.tuning.counts import counted
from jaxguide.tuning.designs import Bounded
from jaxguide.tuning.flown import Flown
from jaxguide.tuning.measures import cost, endpoint_miss, gain_evaluations
from jaxguide.tuning.ready import Confirmed, Ready
from jaxguide.tuning.record import Tuned
from jaxguide.tuning.relaxation import sample_lengths
from jaxguide.tuning.risk import above, quantile_bounds, smooth_quantile

LEVEL = 0.99
MOST = 166  # samples of 0.02 TU in 3.32
MODES = 12  # of the samples' density: the control turns within a tenth of the horizon
STEPS = 4  # of Runge-Kutta a sample while tuning: a tenth of a radian's turn a step at worst
MARGIN = 0.9  # of the paper's percentile: what 512 cases scatter
HOLDS = {"deviation": HoldDeviation, "history": History}


def design(
    hold: str = "deviation",
    bound: float | None = None,
    extremal: Extremal | None = None,
    samples: float = MOST,
    steps: int = 300,
) -> Ready:
    """Neighbouring optimal control on the paper's transfer: how many samples, and where.

    Each sample is one measurement and one stored gain, evaluated once: "gain evaluations". Samples
    lie where a density has them whose logarithm is a Legendre series; their number is relaxed
    (`sample_lengths`). The objective is the number over the paper's 166, and beyond `bound` the
    99th percentile of the miss, sqrt(v_r^2 + (v_t - r^(-1/2))^2) at tf in canonical units.

    **Arguments:** `hold`: of the deviation between samples: "deviation" (zero-order) or "history"
    (eq. 49); `bound`: of the percentile; default `MARGIN` of the paper's interval's with the same
    hold. `samples`: to start from, evenly.
    """
    if hold not in HOLDS:
        raise ValueError(f"design: hold is {hold!r}; choose one of {', '.join(HOLDS)}.")
    extremal = solve(EarthMars()) if extremal is None else extremal
    loop = _Loop(extremal, schedule(extremal), hold)
    if bound is None:
        bound = MARGIN * float(jnp.quantile(loop.misses(loop.paper(), _keys(1, 20_000)), LEVEL))
    flown = Flown(dispersions(), chunk=64)

    def objective(built: tuple[Mission, Array], keys: Array) -> tuple[Array, dict[str, Array]]:
        flying, count = built
        percentile = smooth_quantile(flown(flying, keys), LEVEL)
        # In logarithms: a design may start a thousand times above the bound.
        over = above(1 + jnp.log(percentile / bound), 1.0, 0.1)
        return count / MOST + over, {"p99": percentile, "samples": count}

    def build(own: dict[str, Array]) -> tuple[Mission, Array]:
        return loop.mission(own["samples"], own["places"], MOST), own["samples"]

    # One step changes the number by some per cent at most, and the density likewise.
    rate = optax.cosine_decay_schedule(0.02, steps)
    return Ready(
        name="earth-mars" if hold == "deviation" else f"earth-mars-{hold}",
        about=f"fewest gain evaluations for a 99th-percentile miss below {bound:.3g}, {hold} held",
        objective=objective,
        design={"samples": Bounded(samples, 2.0), "places": jnp.zeros(MODES)},
        build=build,
        optimizer=optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate)),
        steps=steps,
        cases=512,
        confirm=functools.partial(_confirm, loop, objective, build),
        places=_places,
    )


def _places(own: dict[str, Any]) -> dict[str, np.ndarray]:
    """Sample times over the horizon, the number rounded."""
    count = max(round(float(own["samples"])), 1)
    lengths = sample_lengths(float(count), count, 1.0, jnp.asarray(own["places"]))
    return {"samples": np.append(0.0, np.cumsum(np.asarray(lengths)))[:-1]}


def history(**options: Any) -> Ready:
    """As `design`, the law's own open-loop control flown between samples."""
    return design("history", **{"samples": 60.0, "steps": 200, **options})


def schedule(extremal: Extremal) -> GainSchedule:
    """Exact gains anywhere up to a thousandth of the horizon before the end, whatever the samples:
    further on they are held."""
    end = float(extremal.final_time)
    return gain_schedule(extremal, np.append(np.arange(MOST) * SAMPLE_INTERVAL, 0.999 * end))


class _Loop(eqx.Module):
    extremal: Extremal
    schedule: GainSchedule
    hold: str = eqx.field(static=True)

    def mission(
        self, count: Any, places: Any, most: int, steps: int = STEPS
    ) -> Mission:
        end = self.extremal.final_time
        lengths = sample_lengths(jnp.minimum(count, 1.0 * most), most, end, places)
        law = NeighboringOptimal(self.schedule, CAP)
        return Mission(
            self.extremal.problem, law, self.extremal.x[0], lengths, hold=HOLDS[self.hold](),
            integrator=RungeKutta4(steps),
        )  # fmt: skip

    def paper(self) -> Mission:
        """The paper's interval, the same hold."""
        return mission(self.extremal, hold=HOLDS[self.hold](), integrator=RungeKutta4(STEPS))

    def misses(self, flying: Mission, keys: Array) -> Float[np.ndarray, " case"]:
        return np.asarray(_fly(flying, keys)[0])


@eqx.filter_jit
def _fly(flying: Mission, keys: Array) -> Any:
    measure = lambda mission, flight: (endpoint_miss(mission, flight), cost_of(mission, flight))
    return Flown(dispersions(), measure, chunk=2000)(flying, keys)


def cost_of(flying: Any, flight: Any) -> Array:
    """The plant has no running cost, so that ends suffice."""
    return cost(flying, flight)


def _keys(seed: int, cases: int) -> Array:
    return jax.vmap(lambda k: case_key(seed, k))(jnp.arange(cases))


def _confirm(
    loop: _Loop, objective: Any, build: Any, tuned: Tuned, cases: int, seed: int
) -> Confirmed:
    """On fresh cases, with a mission of as many samples as there are and finer integration."""
    own = tuned.design
    keys = _keys(seed, min(cases, 4096))
    at = eqx.filter_jit(lambda n: objective(build(own | {"samples": n}), keys)[0])
    true = lambda n: at(jnp.asarray(float(n)))
    found = counted(true, own["samples"], at(jnp.asarray(own["samples"])), 2, MOST)
    best = loop.mission(jnp.asarray(float(found.count)), own["places"], found.count)
    finer = loop.mission(jnp.asarray(float(found.count)), own["places"], found.count, 4 * STEPS)
    keys, rows, ends = _keys(seed, cases), {}, []
    for flying in (loop.paper(), best, finer):
        miss, radius = (np.asarray(v) for v in _fly(flying, keys))
        low, value, high = quantile_bounds(miss, LEVEL)
        ends.append((gain_evaluations(flying), value, low, high, miss.mean(), -radius.mean()))
    names = (
        "gain evaluations", "99th percentile of the miss", "its lower bound (95 %)",
        "its upper bound (95 %)", "mean miss", "mean final radius",
    )  # fmt: skip
    rows = {name: (float(ends[0][i]), float(ends[1][i])) for i, name in enumerate(names)}
    rows["99th percentile, four times the integration steps"] = (ends[0][1], ends[2][1])
    saved = 1 - rows[names[0]][1] / rows[names[0]][0]
    better = saved > 0 and rows[names[1]][1] <= rows[names[1]][0]
    notes = (
        f"{100 * saved:.1f} % fewer gain evaluations than the paper's interval, the same hold",
        f"true objective of a sample less and more: {found}",
    )
    return Confirmed(rows, found.beside, notes, bool(better))
