"""(c) Whole sweeps, drawing and statistics included: rate, memory, bits, and workers.

    python bench/sweeps.py [--smoke] [--cases N] [--rounds R] [--plain]

Earth-Mars in float64 and float32, `keep="summary"`, in turn with its peers, which are looked for
beside the checkout (`../shared/bench`) or at $JAXGUIDE_PEERS: `rollout_limit.c` (hand-vectorised C
that draws nothing and keeps nothing; gcc with the flags named in it) and `noc_numpy.py --mode zoh`
(SciPy's solver in a Python loop, its gains' time left out). Memory is the highest resident size of
a process that flies N cases (10 million, say), less that of one that has imported JAX and this
package. Weak scaling: Dask workers of one thread, the same number of cases each; they share the
machine's cores, so more workers than cores cannot be faster. XLA's options are those of `jaxguide
sweep`, or with `--plain` its own. One JSON object on stdout.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from jaxguide.host.flags import deciding, set_for_flights

PEERS = Path(os.environ.get("JAXGUIDE_PEERS", Path(__file__).parents[2] / "shared" / "bench"))
FLAGS = ["-O3", "-march=native", "-ffast-math", "-fopenmp"]

CHILD = """
import json, sys
import jax
jax.config.update("jax_enable_x64", True)
import jaxguide as jg
import jaxguide.sweeping.sweep
jax.devices()
# Linux; getrusage would count the parent's size before exec.
lines = lambda: open("/proc/self/status").read().splitlines()
peak = lambda: int(next(s for s in lines() if s.startswith("VmHWM")).split()[1]) / 1e3
bare, (cases, dtype) = peak(), (int(sys.argv[1]), sys.argv[2])
from jaxguide import problems
loop, spread = problems.mission("earth-mars"), problems.dispersions("earth-mars")
made = peak()
data = jg.sweep(loop, spread, cases, 1, keep="summary", dtype=dtype)
print(json.dumps({"cases": cases, "import_MB": bare, "mission_made_MB": made - bare,
    "beyond_import_MB": peak() - bare, "rollouts_per_s": data.attrs["rollouts_per_s"]}))
"""


def limits(folder: str) -> dict[str, Path]:
    """The C peer, built for each precision; none without gcc."""
    source = PEERS / "rollout_limit.c"
    if not source.exists() or shutil.which("gcc") is None:
        return {}
    built = {}
    for dtype, more in (("float64", []), ("float32", ["-DF32"])):
        built[dtype] = Path(folder) / dtype
        command = ["gcc", *FLAGS, *more, str(source), "-o", str(built[dtype]), "-lm"]
        subprocess.run(command, check=True)
    return built


def limit(binary: Path, flights: int) -> float:
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive"}
    told = subprocess.run(
        [str(binary), str(flights)], capture_output=True, text=True, env=environment, check=True
    )
    return json.loads(told.stdout)["rollouts_per_s"]


def scipy_loop() -> float | None:
    """Flights a second of the SciPy loop, without its gains' time."""
    peer = PEERS / "noc_numpy.py"
    if not peer.exists():
        return None
    command = [sys.executable, str(peer), "--mode", "zoh"]
    told = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return 1.0 / (told["sim_s_each"] * told["samples"])


def memory(cases: int, dtype: str) -> dict[str, float]:
    told = subprocess.run(
        [sys.executable, "-c", CHILD, str(cases), dtype], capture_output=True, text=True, check=True
    )
    return json.loads(told.stdout.splitlines()[-1])


def scaling(loop: Any, spread: Any, counts: tuple[int, ...], each: int) -> dict[str, float]:
    """Rate by number of workers, `each` cases a worker; the second sweep of each, compiled."""
    from dask import distributed

    import jaxguide as jg

    rates = {}
    for workers in counts:
        with distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster:
            address = {"scheduler": cluster.scheduler_address, "keep": "summary"}
            jg.sweep(loop, spread, 2 * 65_536, 0, **address)  # workers load their programs
            began = time.perf_counter()
            jg.sweep(loop, spread, workers * each, 1, **address)
            rates[str(workers)] = workers * each / (time.perf_counter() - began)
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="few flights and no workers")
    parser.add_argument("--cases", type=int, default=10_000_000, help="of the memory's sweep")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--plain", action="store_true", help="without XLA's options for flights")
    options = parser.parse_args()
    if not options.plain:
        set_for_flights()  # before JAX starts; the processes started here have them too
    flights = 8192 if options.smoke else 524_288
    rounds = 1 if options.smoke else options.rounds

    import jax

    jax.config.update("jax_enable_x64", True)
    import numpy as np

    import jaxguide as jg
    from jaxguide import problems

    loop, spread = problems.mission("earth-mars"), problems.dispersions("earth-mars")
    out: dict[str, Any] = {
        "jax": jax.__version__,
        "device": str(jax.devices()[0]),
        "cores": os.cpu_count(),
        "xla": deciding(),
        "flights": flights,
    }
    ours: dict[str, list[float]] = {"float64": [], "float32": []}
    theirs: dict[str, list[float]] = {"float64": [], "float32": []}
    python: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        peers = limits(folder)
        for k in range(rounds + 1):
            for dtype in ours:
                swept = jg.sweep(loop, spread, flights, k, keep="summary", dtype=dtype)
                if k > 0 or options.smoke:  # the first round warms up
                    ours[dtype].append(swept.attrs["rollouts_per_s"])
                    if dtype in peers:
                        theirs[dtype].append(limit(peers[dtype], 65_536))
            if k == 1 or (k > 1 and not options.smoke and k <= 3):
                rate = scipy_loop()
                python += [] if rate is None else [rate]
        store = Path(folder) / "all.zarr"
        began = time.perf_counter()
        stored = jg.sweep(loop, spread, flights, 1, store=store)
        size = sum(p.stat().st_size for p in store.rglob("*") if p.is_file())
        out["into_a_store"] = {
            "rollouts_per_s": stored.attrs["rollouts_per_s"],
            "bytes_per_case": size / flights,
            "wall_s": time.perf_counter() - began,
        }
    for dtype, rates in ours.items():
        told: dict[str, Any] = {"rollouts_per_s": max(rates)}
        if theirs[dtype]:
            told["c_rollouts_per_s"] = max(theirs[dtype])
            told["ratio_of_best"] = max(rates) / max(theirs[dtype])
            told["ratio_median"] = float(np.median(np.asarray(rates) / np.asarray(theirs[dtype])))
        if python:
            told["times_the_scipy_loop"] = max(rates) / max(python)
        out[dtype] = told
    out["scipy_loop_rollouts_per_s"] = max(python, default=None)

    cases = 2000 if options.smoke else 50_000
    a, b = (jg.sweep(loop, spread, cases, 2, chunk=chunk, tile=512) for chunk in (1000, 7777))
    timed = ("rollouts_per_s", "compile_s")
    same = all(np.array_equal(a[name].values, b[name].values) for name in a.variables)
    same &= all(a.attrs[k] == b.attrs[k] for k in a.attrs if k not in timed)
    out["chunks_of_1000_and_7777_bit_identical"] = bool(same)
    many = 20_000 if options.smoke else options.cases
    dtypes = ("float64",) if options.smoke else ("float64", "float32")
    out["memory"] = {dtype: memory(many, dtype) for dtype in dtypes}
    if not options.smoke:
        out["weak_scaling_rollouts_per_s"] = scaling(loop, spread, (1, 2), 524_288)
    json.dump(out, sys.stdout, indent=1)
    print()
    if not same:
        sys.exit("sweeps in chunks of 1,000 and 7,777 differ")


if __name__ == "__main__":
    main()
