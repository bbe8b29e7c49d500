"""The same measurements in this checkout and in another, in turn: has a change cost time?

    python bench/old_and_new.py OTHER [--rounds N]
    python bench/old_and_new.py --smoke

OTHER is the path of another checkout of this repository, "old". Each round measures old and new,
each in a process of its own, so that a busy machine disturbs both alike; of every number the best
round counts. A ratio is new over old: of seconds, below 1 is faster; of flights a second, above 1.
`--smoke` compares this checkout with itself, once and small, so its ratios are noise.

Programs are compiled afresh in every process, without a cache. One JSON object on stdout.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
TILE = 512  # flights mapped together, so that memory stays small
# LGL 32, that is 33 nodes; LGR with 6 nodes on each of 12 segments; the paper's 166 gains.
WHOLE = {"lgl_nodes": 33, "lgr_segments": 12, "gains": 166, "flights": 65_536, "repeats": 20}
SMALL = {"lgl_nodes": 9, "lgr_segments": 2, "gains": 12, "flights": 2 * TILE, "repeats": 1}


def least(run: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Seconds of the first call of `run`, with compilation, and the least of `repeats` more."""
    import jax

    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    return seconds[0], min(seconds[1:])


def measured(small: bool) -> dict[str, float]:
    """All numbers of the checkout that Python finds first. Public names only: both have them."""
    began = time.perf_counter()
    import jaxguide as jg

    jg.solve  # noqa: B018  names are imported when first used
    out = {"import_s": time.perf_counter() - began}

    import dataclasses

    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    from jaxguide import problems

    size = SMALL if small else WHOLE
    repeats, problem = size["repeats"], problems.get("earth-mars")
    meshes = {
        "solve_lgl": jg.Pseudospectral("lgl", size["lgl_nodes"], 1, refinements=0),
        "solve_lgr": jg.Pseudospectral("lgr-right", 6, size["lgr_segments"], refinements=0),
    }
    for name, method in meshes.items():
        at = lambda thrust, method=method: (
            jg.solve(dataclasses.replace(problem, thrust=thrust), method, throw=False).objective
        )
        program = jax.jit(at)
        thrust = jnp.asarray(problem.thrust)
        run = lambda program=program, thrust=thrust: program(thrust)
        out[f"{name}_first_s"], out[f"{name}_s"] = least(run, repeats)

    extremal = jg.solve(problem, jg.Shooting(starts=4))
    times = jnp.arange(size["gains"]) * 0.02
    schedules = jax.jit(lambda e: jg.gain_schedule(e, times).K)
    first, warm = least(lambda: schedules(extremal), 5 * repeats)
    out["gains_first_s"], out["gains_s"] = first, warm

    loop, spread = problems.mission("earth-mars"), problems.dispersions("earth-mars")
    tile = lambda keys: jg.rollouts(loop, spread, keys).final_state
    fly = jax.jit(lambda keys: jax.lax.map(tile, keys))
    keys = jax.random.split(jax.random.key(0), size["flights"]).reshape(-1, TILE)
    first, warm = least(lambda: fly(keys), min(repeats, 5))
    out["rollouts_first_s"], out["flights_a_second"] = first, size["flights"] / warm
    return out


def in_checkout(path: Path, small: bool) -> dict[str, float]:
    """`measured` in a new process that finds the package in the folder `path`."""
    environment = {
        **os.environ, "PYTHONPATH": str(path), "EQX_ON_ERROR": "nan", "TF_CPP_MIN_LOG_LEVEL": "3",
        "JAX_ENABLE_COMPILATION_CACHE": "false",
    }  # fmt: skip
    command = [sys.executable, str(Path(__file__).resolve()), "--one", *["--smoke"] * small]
    out = subprocess.run(
        command, env=environment, cwd=path, stdout=subprocess.PIPE, text=True, check=True
    )
    found = json.loads(out.stdout.splitlines()[-1])
    where = Path(found.pop("package"))
    if where != path / "jaxguide":
        raise SystemExit(f"{path} was to be measured, but Python imported {where}.")
    return found


def commit(path: Path) -> str | None:
    git = subprocess.run(
        ["git", "-C", str(path), "rev-parse", "HEAD"], capture_output=True, text=True
    )
    return git.stdout.strip() or None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", nargs="?", type=Path, help="the other checkout's folder")
    parser.add_argument("--rounds", type=int, default=3, help="processes for each checkout")
    parser.add_argument("--smoke", action="store_true", help="this checkout with itself, small")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        found = measured(options.smoke)
        import jaxguide

        print(json.dumps(found | {"package": str(Path(jaxguide.__file__).resolve().parent)}))
        return
    if options.other is None and not options.smoke:
        parser.error("give the path of another checkout, or --smoke")
    paths = {"old": HERE if options.smoke else options.other.resolve(), "new": HERE}
    rounds: dict[str, list[dict[str, float]]] = {name: [] for name in paths}
    for k in range(1 if options.smoke else options.rounds):
        # The order alternates: a machine that warms up or tires favours neither.
        for name in list(paths)[:: -1 if k % 2 else 1]:
            rounds[name].append(in_checkout(paths[name], options.smoke))
    best = lambda name, key: (max if key == "flights_a_second" else min)(
        found[key] for found in rounds[name]
    )
    keys = rounds["new"][0]
    seconds = {name: {key: best(name, key) for key in keys} for name in paths}
    out = {
        "sizes": SMALL if options.smoke else WHOLE,
        "rounds": len(rounds["new"]),
        "commits": {name: commit(path) for name, path in paths.items()},
        **seconds,
        "new_over_old": {key: seconds["new"][key] / seconds["old"][key] for key in keys},
    }
    json.dump(out, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
