"""(a) Gain schedules against the paper-literal NumPy way, and over many nominals.

    python bench/gains.py [--smoke]

The peer, `noc_numpy.py`, is looked for beside the checkout (`../shared/bench`) or at
$JAXGUIDE_PEERS; without it only our own times are printed. One JSON object on stdout.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxguide as jg  # noqa: E402
from jaxguide.host.cores import over_cores  # noqa: E402
from jaxguide.problems import EarthMars  # noqa: E402
from jaxguide.problems.earth_mars import mission  # noqa: E402

PEERS = Path(os.environ.get("JAXGUIDE_PEERS", Path(__file__).parents[2] / "shared" / "bench"))
TIMES = np.arange(166) * 0.02
SETTINGS = {"default": {}, "1e-12": {"segments": 96, "nodes": 10, "sweeps": 10}}


def best_of(run: Callable[[], Any], repeats: int) -> float:
    """Least wall seconds of `run` over `repeats`, after one warm-up."""
    jax.block_until_ready(run())
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def cold(run: Callable[[], Any]) -> tuple[Any, float]:
    """The value of `run`, and its wall seconds with whatever it compiles."""
    began = time.perf_counter()
    value = jax.block_until_ready(run())
    return value, time.perf_counter() - began


def measure_schedules(extremal: jg.Extremal, repeats: int, out: dict[str, Any]) -> dict[str, Any]:
    """Time and error of the gains by each of SETTINGS, into `out`; returns the runs by row."""
    times = jnp.asarray(TIMES)
    finest = jg.gain_schedule(extremal, times, segments=160, nodes=14, sweeps=20)
    size = jnp.max(jnp.abs(finest.K), axis=(1, 2))
    runs = {}
    for name, options in SETTINGS.items():
        compiled = jax.jit(lambda e, t, o=options: jg.gain_schedule(e, t, **o), keep_unused=True)
        ours = compiled(extremal, times)
        error = jnp.max(jnp.abs(ours.K - finest.K), axis=(1, 2)) / size
        runs[f"gains_{name}"] = run = lambda compiled=compiled: compiled(extremal, times)
        out[f"gains_{name}"] = {
            "options": options,
            "ms": 1e3 * best_of(run, repeats),
            "median_error": float(jnp.median(error)),
            "max_error_to_3.2": float(jnp.max(error[TIMES <= 3.2])),
            "max_error": float(jnp.max(error)),
        }
    return runs


def measure_flights(extremal: jg.Extremal, repeats: int, out: dict[str, Any]) -> Callable[[], Any]:
    """Time of one closed-loop flight, alone and with its gains, into `out`; returns the latter."""
    times, loop = jnp.asarray(TIMES), mission(extremal)
    shift = jnp.asarray([0.0033, 0.0, 0.0])
    perturbed = eqx.tree_at(lambda m: m.initial_state, loop, loop.initial_state + shift)
    fly = jax.jit(lambda m: jg.simulate(m).final_state)
    out["closed_loop_flight_ms"] = 1e3 * best_of(lambda: fly(perturbed), repeats)
    parts = lambda m: (m.law.schedule, m.initial_state)
    with_gains = jax.jit(lambda e, x: jg.simulate(
        eqx.tree_at(parts, loop, (jg.gain_schedule(e, times), x))
    ).final_state)  # fmt: skip
    run = lambda: with_gains(extremal, perturbed.initial_state)
    out["closed_loop_with_gains_ms"] = 1e3 * best_of(run, repeats)
    return run


def measure_many(extremal: jg.Extremal, smoke: bool, out: dict[str, Any]) -> None:
    """Time of many nominals, and of the gains of each, one thread a core, into `out`."""
    count = 8 if smoke else 1000
    thrusts = 0.1405 * (1 + 0.01 * np.linspace(-1, 1, count))
    nominals = jax.jit(jax.vmap(
        lambda thrust: jg.solve(dataclasses.replace(EarthMars(), thrust=thrust), guess=extremal)
    ))  # fmt: skip
    batch, out["nominals_cold_s"] = cold(lambda: nominals(jnp.asarray(thrusts)))
    if not smoke:
        _, out["nominals_warm_s"] = cold(lambda: nominals(jnp.asarray(thrusts)))
    times, cores = jnp.asarray(TIMES), 2
    schedules = jax.jit(lambda batch: jax.lax.map(lambda e: jg.gain_schedule(e, times).K, batch))
    shares = [jax.tree_util.tree_map(lambda a, i=i: a[i::cores], batch) for i in range(cores)]
    ready = lambda share: jax.block_until_ready(schedules(share))
    many = lambda: list(over_cores(ready, shares))
    out["many_schedules"] = {
        "nominals": count,
        "converged": int(np.sum(np.asarray(batch.residual) < 1e-10)),
        "ms_per_schedule": 1e3 * best_of(many, 3) / count,
    }


def compare_with_peer(
    peer: Path, schedules: dict[str, Any], flight: Callable[[], Any], repeats: int, out: dict
) -> None:
    """Runs the peer, then ours again (a busy machine disturbs both), and adds the ratios and
    verdicts to `out`."""
    command = [sys.executable, str(peer), "--mode", "zoh"]
    theirs = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    gains_s = theirs["gain_s_each"] * theirs["samples"]
    for row, run in schedules.items():
        out[row]["ms"] = min(out[row]["ms"], 1e3 * best_of(run, repeats))
        out[row]["times_faster"] = 1e3 * gains_s / out[row]["ms"]
    loop_ms = min(out["closed_loop_with_gains_ms"], 1e3 * best_of(flight, repeats))
    out["closed_loop_with_gains_ms"] = loop_ms
    out["numpy_gains_s"], out["numpy_closed_loop_s"] = gains_s, theirs["closed_loop_s"]
    out["closed_loop_times_faster"] = 1e3 * theirs["closed_loop_s"] / loop_ms
    out["within"] = {
        "error": out["gains_default"]["max_error_to_3.2"] <= 1e-9,
        "gains": out["gains_default"]["times_faster"] >= 2000,
        "closed_loop": out["closed_loop_times_faster"] >= 500,
        "many_schedules": out["many_schedules"]["ms_per_schedule"] <= 1,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="few repeats, no peer")
    smoke = parser.parse_args().smoke
    repeats = 3 if smoke else 200
    out: dict[str, Any] = {
        "jax": jax.__version__,
        "device": str(jax.devices()[0]),
        "dtype": "float64",
    }
    extremal, out["solve_cold_s"] = cold(lambda: jg.solve(EarthMars()))
    _, out["schedule_cold_s"] = cold(lambda: jg.gain_schedule(extremal, jnp.asarray(TIMES)))
    schedules = measure_schedules(extremal, repeats, out)
    flight = measure_flights(extremal, repeats, out)
    measure_many(extremal, smoke, out)
    peer = PEERS / "noc_numpy.py"
    if peer.exists() and not smoke:
        compare_with_peer(peer, schedules, flight, repeats, out)
    json.dump(out, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
