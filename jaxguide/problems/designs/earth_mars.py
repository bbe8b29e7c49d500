"""Earth-Mars: how few samples, and where, keep the 99th percentile of the miss below a bound."""

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
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal
from jaxguide.tuning.counts import Count, counted
from jaxguide.tuning.flown import Flown
from jaxguide.tuning.measures import cost, endpoint_miss, gain_evaluations
from jaxguide.tuning.ready import Confirmed, Ready
from jaxguide.tuning.record import Tuned
from jaxguide.tuning.relaxation import sample_lengths
from jaxguide.tuning.risk import above, quantile_bounds, smooth_quantile
from jaxguide.tuning.variables import Bounded

LEVEL = 0.99  # of the percentile
MOST = 166  # samples of 0.02 TU in 3.32
MODES = 12  # Legendre modes of the density: the control turns within a tenth of the horizon
STEPS = 4  # of Runge-Kutta a sample while tuning: a tenth of a radian's turn a step at worst
MARGIN = 0.9  # of the paper's percentile: that of 512 cases scatters by a tenth
HOLDS = {"deviation": HoldDeviation, "history": History}


def design(
    hold: str = "deviation",
    bound: float | None = None,
    extremal: Extremal | None = None,
    samples: float = MOST,
    most: int = MOST,
    steps: int = 300,
) -> Ready:
    """Neighbouring optimal control on the 2002 paper's transfer: how many samples, and where.

    Each sample is one measurement and one stored gain, evaluated once: "gain evaluations". Samples
    are spread with a density whose logarithm is a Legendre series; their number is relaxed to a
    real one (`sample_lengths`). The objective is the number over the paper's 166, plus a penalty
    where the 99th percentile of the miss, sqrt(v_r^2 + (v_t - r^(-1/2))^2) at tf in canonical
    units, is above `bound`.

    **Arguments:**

    - `hold`: of the deviation between samples: "deviation" (zero-order) or "history" (2002 paper,
      eq. (49)).
    - `bound`: of the percentile; by default `MARGIN` times that of the paper's sample interval with
      the same hold.
    - `extremal`: the nominal, solved for if absent.
    - `samples`: their number at first, evenly spread; `most`: the largest number allowed.
    - `steps`: of the optimiser.

    **Raises:** `ValueError` for another `hold`.
    """
    if hold not in HOLDS:
        raise ValueError(f"design: hold is {hold!r}; choose one of {', '.join(HOLDS)}.")
    extremal = solve(EarthMars()) if extremal is None else extremal
    loop = _Loop(extremal, schedule(extremal), hold)
    if bound is None:
        bound = MARGIN * float(jnp.quantile(loop.misses(loop.paper(), _keys(1, 20_000)), LEVEL))
    objective = functools.partial(_objective, bound)
    build = functools.partial(_build, loop, most)
    name = "earth-mars" if hold == "deviation" else f"earth-mars-{hold}"
    # One step changes the number by some per cent at most, and the density likewise.
    rate = optax.cosine_decay_schedule(0.02, steps)
    ready = Ready(
        name=name,
        about=f"fewest gain evaluations for a 99th-percentile miss below {bound:.3g}, {hold} held",
        objective=objective,
        design={"samples": Bounded(samples, 2.0), "places": jnp.zeros(MODES)},
        build=build,
        optimizer=optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate)),
        steps=steps,
        cases=512,
        confirm=functools.partial(_confirm, loop),
        places=_places,
    )
    return ready._replace(rounded=functools.partial(_rounded, loop, ready, most))


def _objective(
    bound: float, built: tuple[Mission, Array], keys: Array
) -> tuple[Array, dict[str, Array]]:
    flying, count = built
    percentile = smooth_quantile(Flown(dispersions(), chunk=64)(flying, keys), LEVEL)
    # In logarithms: a design may start a thousand times above the bound.
    over = above(1 + jnp.log(percentile / bound), 1.0, 0.1)
    return count / MOST + over, {"p99": percentile, "samples": count}


def _build(loop: "_Loop", most: int, own: dict[str, Any]) -> tuple[Mission, Array]:
    return loop.mission(own["samples"], own["places"], most), own["samples"]


def _rounded(loop: "_Loop", ready: Ready, most: int, tuned: Tuned) -> Ready:
    """The better of the two integers beside the number found, and the places tuned further for it:
    the best places of an integer differ from those of a number between two integers."""
    own, keys = jax.tree_util.tree_map(jnp.asarray, tuned.design), _keys(0, ready.cases)
    at = eqx.filter_jit(lambda n: ready.objective(ready.build(own | {"samples": n}), keys)[0])
    found = counted(lambda n: at(jnp.asarray(float(n))), own["samples"], tuned.loss, 2, most)
    count = jnp.asarray(float(found.count))

    def build(places: dict[str, Any]) -> tuple[Mission, Array]:
        return _build(loop, found.count, {"samples": count, **places})

    def objective(built: tuple[Mission, Array], keys: Array) -> tuple[Array, dict[str, Array]]:
        percentile = ready.objective(built, keys)[1]["p99"]
        return jnp.log(percentile), {"p99": percentile}

    def confirm(polished: Tuned, cases: int, seed: int) -> Confirmed:
        whole = polished._replace(design={"samples": np.asarray(count), **polished.design})
        return _confirm(loop, whole, cases, seed, found)

    return ready._replace(
        about=f"{ready.about}: places of {found.count} samples",
        objective=objective,
        build=build,
        design={"places": jnp.asarray(own["places"])},
        optimizer=optax.adam(optax.cosine_decay_schedule(0.005, 150)),
        steps=150,
        cases=1024,
        confirm=confirm,
        places=lambda own: _places({"samples": count, **own}),
        rounded=None,
    )


def _places(own: dict[str, Any]) -> dict[str, np.ndarray]:
    """Sample times as fractions of the horizon, the number of samples rounded."""
    count = max(round(float(own["samples"])), 1)
    lengths = sample_lengths(float(count), count, 1.0, jnp.asarray(own["places"]))
    return {"samples": np.append(0.0, np.cumsum(np.asarray(lengths)))[:-1]}


def history(**options: Any) -> Ready:
    """`design` with the law's own open-loop control between samples; `options`: of `design`."""
    return design("history", **{"samples": 60.0, "most": 60, "steps": 200, **options})


def schedule(extremal: Extremal) -> GainSchedule:
    """Exact gains at 167 times up to a thousandth of the horizon before the end, for any samples in
    between; later the last gain is held."""
    end = float(extremal.final_time)
    return gain_schedule(extremal, np.append(np.arange(MOST) * SAMPLE_INTERVAL, 0.999 * end))


class _Loop(eqx.Module):
    extremal: Extremal
    schedule: GainSchedule
    hold: str = eqx.field(static=True)

    def mission(self, count: Any, places: Any, most: int, steps: int = STEPS) -> Mission:
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
    """The plant's cost; it has no running cost, so that a flight's ends suffice."""
    return cost(flying, flight)


def _keys(seed: int, cases: int) -> Array:
    return jax.vmap(lambda k: case_key(seed, k))(jnp.arange(cases))


def _confirm(
    loop: _Loop, tuned: Tuned, cases: int, seed: int, found: Count | None = None
) -> Confirmed:
    """Flies fresh cases with the tuned number of samples as the mission's own, with finer
    integration, and with one sample less and one more."""
    own, keys = tuned.design, _keys(seed, cases)
    count = max(round(float(own["samples"])), 2)
    true = lambda n, steps: loop.mission(jnp.asarray(float(n)), own["places"], n, steps)
    flown = (loop.paper(), true(count, STEPS), true(count, 4 * STEPS))
    columns = [_ends(flying, keys) for flying in flown]
    names = (
        "gain evaluations", "99th percentile of the miss", "its lower bound (95 %)",
        "its upper bound (95 %)", "mean miss", "mean final radius",
    )  # fmt: skip
    rows = {name: (columns[0][i], columns[1][i]) for i, name in enumerate(names)}
    rows["99th percentile, four times the integration steps"] = (columns[0][1], columns[2][1])
    beside = {count: columns[1][1]}
    for n in (count - 1, count + 1):
        beside[n] = _ends(true(n, STEPS), keys[: min(cases, 20_000)])[1]
    saved = 1 - rows[names[0]][1] / rows[names[0]][0]
    better = saved > 0 and rows[names[1]][1] <= rows[names[1]][0]
    notes = [f"{100 * saved:.1f} % fewer gain evaluations than the paper's, the same hold"]
    if found is not None:
        notes.append(f"objective before the places were tuned on: {found}")
    listed = ", ".join(f"{n}: {beside[n]:.4g}" for n in sorted(beside))
    notes.append(f"99th percentile with a sample less and more, the same density: {listed}")
    return Confirmed(rows, beside, tuple(notes), bool(better))


def _ends(flying: Mission, keys: Array) -> tuple[float, ...]:
    miss, radius = (np.asarray(v) for v in _fly(flying, keys))
    low, value, high = quantile_bounds(miss, LEVEL)
    return (
        float(gain_evaluations(flying)), value, low, high, float(miss.mean()),
        -float(radius.mean()),
    )  # fmt: skip
