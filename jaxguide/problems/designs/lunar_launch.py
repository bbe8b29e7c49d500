"""Lunar launch: the best places of the control's nodes, and which gain stations to store."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxguide.flight.integrators import RungeKutta4
from jaxguide.flight.mission import Mission
from jaxguide.flight.simulate import Flight
from jaxguide.host.compilation import quick_compilation
from jaxguide.laws.holds import History
from jaxguide.laws.suboptimal import TimeToGo
from jaxguide.montecarlo.rollouts import case_key
from jaxguide.neighboring.suboptimal import suboptimal_gains
from jaxguide.nominal.parametric.piecewise_linear import PiecewiseLinear
from jaxguide.problems.lunar_launch import (
    POWERS,
    QUIET,
    SAMPLE_INTERVAL,
    LunarLaunch,
    dispersions,
)
from jaxguide.solving.solve import solve
from jaxguide.trajectory import Extremal
from jaxguide.tuning.flown import Flown
from jaxguide.tuning.ready import Confirmed, Ready
from jaxguide.tuning.record import Tuned
from jaxguide.tuning.relaxation import cooling, occupancy
from jaxguide.tuning.thinned import ThinnedGains
from jaxguide.tuning.variables import Ascending

NODES, STATIONS = 9, 7  # the thesis's nodes; from the last two the end cannot be controlled
WEIGHTS = (1.0, 0.1, 0.1)  # of squared errors of y [ft], u and v [ft/s] at the end (chosen)
PRICE = 0.05  # of a stored station, in e-folds of the mean squared error (chosen)
SAMPLES = 84  # 72 in the longest flight, and some for its end


def design(steps: int = 80, nominal: Extremal | None = None) -> Ready:
    """The library's own closed loop (exact gains, scaled by the time to go): the places of nine
    nodes of the control, and which of seven gain stations, at the first seven nodes, are stored.

    The objective is the logarithm of the mean weighted squared error at the end over dispersed
    launches, plus a price for each station. Every gradient goes through the nominal re-optimised
    for the nodes, its second derivatives and gains, the search for the reference time, and the
    flights.

    **Arguments:** `steps`: of the optimiser; `nominal`: solved for if absent.
    """
    nominal = solve(LunarLaunch(), PiecewiseLinear(NODES)) if nominal is None else nominal
    make = functools.partial(_build, nominal)
    return Ready(
        name="lunar-launch",
        about="nodes of the control, and the gain stations worth storing",
        objective=_objective,
        # A logit of 2: each inner station is present to 0.88 at first, and may still change.
        design={
            "nodes": Ascending(np.linspace(0.0, 1.0, NODES)),
            "present": jnp.full(STATIONS - 2, 2.0),
        },
        build=make,
        optimizer=optax.adam(optax.cosine_decay_schedule(0.1, steps)),
        steps=steps,
        cases=40,
        confirm=functools.partial(_confirm, make),
        places=_places,
        temperature=cooling(1.0, 0.1, steps),
        compiler_options=quick_compilation(),
    )


def _build(
    nominal: Extremal, own: dict[str, Any], temperature: Any
) -> tuple[Mission, Float[Array, " g"]]:
    """The mission, and each station's presence from 0 to 1."""
    present = jnp.pad(occupancy(own["present"], temperature), 1, constant_values=1.0)
    nodes = own["nodes"]
    again = solve(LunarLaunch(), PiecewiseLinear(nodes), nominal, throw=False)
    schedule = suboptimal_gains(again, "remaining", nodes[:STATIONS])
    law = TimeToGo(schedule, ThinnedGains(jnp.asarray(POWERS), present), quiet=QUIET)
    flying = Mission(
        LunarLaunch(), law, again.x[0], SAMPLE_INTERVAL, hold=History(),
        integrator=RungeKutta4(1), max_samples=SAMPLES,
    )  # fmt: skip
    return flying, present


def squared_miss(flying: Mission, flight: Flight) -> Float[Array, ""]:
    """Sum of the squared errors of y, u, v at the end, with WEIGHTS [ft^2]."""
    plant: Any = flying.plant
    off = flight.final_state[1:] - jnp.stack([jnp.asarray(v) for v in plant.orbit])
    return jnp.sum(jnp.asarray(WEIGHTS, off.dtype) * off**2)


def _objective(built: tuple[Mission, Array], keys: Array) -> tuple[Array, dict[str, Array]]:
    flying, present = built
    error = jnp.mean(Flown(dispersions(), squared_miss, chunk=20)(flying, keys))
    stations = jnp.sum(present)
    return jnp.log(error) + PRICE * stations, {"squared miss": error, "stations": stations}


def _places(own: dict[str, Any]) -> dict[str, np.ndarray]:
    nodes = np.asarray(own["nodes"])
    there = np.concatenate([[True], np.asarray(own["present"]) > 0, [True]])
    return {"nodes": nodes, "gain stations": nodes[:STATIONS][there]}


def subsets(make: Any, own: dict[str, Any], keys: Array) -> dict[tuple[int, ...], float]:
    """The objective, not relaxed, of every choice of inner stations, with the nodes of `own`: by
    choice, 1 where a station is stored."""
    # A logit of 40 or -40 at temperature 1 is a one or a zero, to rounding.
    true = jax.jit(
        lambda nodes, there: _objective(
            make({"nodes": nodes, "present": there}, jnp.ones(())), keys
        )[0],
        compiler_options=quick_compilation(),  # pyright: ignore[reportArgumentType]
    )
    nodes = jnp.asarray(own["nodes"])
    choices = itertools.product((0, 1), repeat=STATIONS - 2)
    return {c: float(true(nodes, 80.0 * jnp.asarray(c, nodes.dtype) - 40)) for c in choices}


def _confirm(make: Any, tuned: Tuned, cases: int, seed: int) -> Confirmed:
    """Flies fresh cases, and compares the choice of stations found with every other."""
    chosen = tuple(int(p > 0) for p in tuned.design["present"])
    every = subsets(make, tuned.design, _keys(seed, 64))
    order = sorted(every, key=lambda c: every[c])
    hard = lambda choice: 80.0 * jnp.asarray(choice, jnp.result_type(float)) - 40

    @functools.partial(jax.jit, compiler_options=quick_compilation())  # pyright: ignore
    def fly(nodes: Array, there: Array, keys: Array) -> Array:
        flying, _ = make({"nodes": nodes, "present": there}, jnp.ones(()))
        return Flown(dispersions(), squared_miss, chunk=500)(flying, keys)

    keys, all_there = _keys(seed, cases), (1,) * (STATIONS - 2)
    one = lambda own, choice: np.asarray(fly(jnp.asarray(own["nodes"]), hard(choice), keys))
    before, after = one(tuned.start, all_there), one(tuned.design, chosen)
    rows = {
        "stored gain stations": (float(STATIONS), 2.0 + sum(chosen)),
        "mean squared miss": (float(before.mean()), float(after.mean())),
        "99th percentile of the squared miss": (
            float(np.quantile(before, 0.99)), float(np.quantile(after, 0.99)),
        ),
    }  # fmt: skip
    least = {n: min(v for c, v in every.items() if 2 + sum(c) == n) for n in range(2, STATIONS + 1)}
    notes = (
        f"of all {len(every)} choices of inner stations the one found is number "
        f"{order.index(chosen) + 1}; its objective {every[chosen]:.6g}, the best "
        f"{every[order[0]]:.6g}",
    )
    return Confirmed(
        rows, least, notes, rows["mean squared miss"][1] < rows["mean squared miss"][0]
    )


def _keys(seed: int, cases: int) -> Array:
    return jax.vmap(lambda k: case_key(seed, k))(jnp.arange(cases))
