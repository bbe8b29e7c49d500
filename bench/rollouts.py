"""(b) Closed-loop rollouts a second through the general `simulate`, against hand-vectorised C.

    python bench/rollouts.py [--smoke] [--fast]

RK4, two steps a sample, du held, |du| <= 0.3, gains looked up once, float64. The peer,
`rollout_limit.c`, is looked for beside the checkout (`../shared/bench`) or at $JAXGUIDE_PEERS and
built with gcc; ours and it are run in turn. `--fast` sets XLA flags for the process that let one
fused loop have several outputs. One JSON object on stdout.
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

FAST = (
    "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion,"
    "xla_cpu_small_while_loop_byte_threshold=100000000"
)
if "--fast" in sys.argv:
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FAST}".strip()

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxguide as jg  # noqa: E402
from jaxguide.flight.simulate import prepare, simulate  # noqa: E402
from jaxguide.host.cores import over_cores  # noqa: E402
from jaxguide.problems.earth_mars import dispersions, mission  # noqa: E402
from jaxguide.sweeping.tiles import TILE, compiler_options  # noqa: E402

PEERS = Path(os.environ.get("JAXGUIDE_PEERS", Path(__file__).parents[2] / "shared" / "bench"))


def build_peer(folder: str) -> Path | None:
    source = PEERS / "rollout_limit.c"
    if not source.exists() or shutil.which("gcc") is None:
        return None
    binary = Path(folder) / "limit"
    flags = ["-O3", "-march=native", "-ffast-math", "-fopenmp"]
    subprocess.run(["gcc", *flags, str(source), "-o", str(binary), "-lm"], check=True)
    return binary


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="few flights, no peer")
    parser.add_argument("--fast", action="store_true", help="XLA flags for multi-output fusion")
    options = parser.parse_args()
    flights = 8192 if options.smoke else 65536
    rounds = 2 if options.smoke else 7
    loop = mission()
    spread = 1e-3 * np.random.default_rng(0).standard_normal((flights, 3))
    starts = np.asarray(loop.initial_state) + spread
    tile = 128 if options.fast else TILE
    prepared = jax.jit(prepare)(loop)

    def fly_tiles(loop: Any, prepared: Any, starts: jax.Array) -> Any:
        one = lambda x: simulate(
            eqx.tree_at(lambda m: m.initial_state, loop, x), None, "ends", prepared
        )
        return jax.lax.map(lambda xs: jax.vmap(one)(xs).final_state, starts)

    share = (
        starts.reshape(2 * 4, -1, tile, 3)
        if flights // tile >= 8
        else starts.reshape(2, -1, tile, 3)
    )
    began = time.perf_counter()
    compiled = (
        jax.jit(fly_tiles)
        .lower(loop, prepared, jnp.asarray(share[0]))
        .compile(compiler_options=compiler_options())
    )
    compile_s = time.perf_counter() - began
    shares = [jnp.asarray(part) for part in share]
    fly = lambda share: jax.block_until_ready(compiled(loop, prepared, share))
    run = lambda: list(over_cores(fly, shares))
    run()
    ours, theirs = [], []
    with tempfile.TemporaryDirectory() as folder:
        binary = None if options.smoke else build_peer(folder)
        for _ in range(rounds):
            began = time.perf_counter()
            run()
            ours.append(flights / (time.perf_counter() - began))
            if binary is not None:
                environment = {**os.environ, "OMP_WAIT_POLICY": "passive"}
                peer = subprocess.run(
                    [str(binary), str(flights)], capture_output=True, text=True, env=environment
                )
                theirs.append(json.loads(peer.stdout)["rollouts_per_s"])
    out: dict[str, Any] = {
        "jax": jax.__version__,
        "device": str(jax.devices()[0]),
        "dtype": "float64",
        "fast": options.fast,
        "tile": tile,
        "flights": flights,
        "compile_s": compile_s,
        "rollouts_per_s": max(ours),
    }
    if theirs:
        out |= {
            "c_rollouts_per_s": max(theirs),
            "ratio_of_best": max(ours) / max(theirs),
            "ratio_median": float(np.median(np.asarray(ours) / np.asarray(theirs))),
        }
    sweep = jg.sweep(loop, dispersions(), flights, 0, tile=tile)
    out["sweep_rollouts_per_s"] = sweep.attrs["rollouts_per_s"]
    json.dump(out, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
