"""What a user waits for: imports, `jaxguide --help`, and the main job cold and from the cache.

    python bench/cold_start.py [--smoke]

Each number is of a fresh process. Imports and `--help`: the least of several, interleaved so that
a busy machine disturbs all alike. The main job runs once with an empty compilation cache, then with
the cache it left (the least of three). `--smoke` leaves the main job out and judges nothing.

Prints one JSON object; exits with 1 if a limit is exceeded.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

CLI = "from jaxguide.cli import main; main()"
# Seconds, and the ratio of the imports.
LIMITS = {"import_ratio": 1.5, "reproduce_cold_s": 30.0, "reproduce_cached_s": 10.0}


def seconds(*arguments: str, **environment: str) -> float:
    start = time.perf_counter()
    command = [sys.executable, "-c", *arguments]
    subprocess.run(command, env=os.environ | environment, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - start


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--smoke", action="store_true")
    smoke = parser.parse_args().smoke

    programs = {
        "import_diffrax_s": ("import diffrax",),
        # `solve` is touched, so that a package which imports lazily shows its true cost.
        "import_jaxguide_s": ("import jaxguide; jaxguide.solve",),
        "help_s": (CLI, "--help"),
    }
    runs: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(2 if smoke else 7):  # the first fills the file cache
        for name, arguments in programs.items():
            runs[name].append(seconds(*arguments))
    found = {name: min(times) for name, times in runs.items()}
    found["import_ratio"] = found["import_jaxguide_s"] / found["import_diffrax_s"]

    if not smoke:
        with tempfile.TemporaryDirectory() as cache:
            job = (CLI, "reproduce", "earth-mars", "--json")
            run = lambda *more: seconds(*job, *more, JAX_COMPILATION_CACHE_DIR=cache)
            found["reproduce_cold_s"] = run()
            found["reproduce_cached_s"] = min(run() for _ in range(3))
            found["reproduce_cached_with_figures_s"] = min(run("--out", cache) for _ in range(3))

    import jax

    within = {name: found[name] <= limit for name, limit in LIMITS.items() if name in found}
    about = {
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "commit": _commit(),
    }
    print(json.dumps({"bench": "cold_start", **found, "within": within, "about": about}, indent=1))
    return 0 if smoke or all(within.values()) else 1


def _commit() -> str | None:
    git = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True)
    return git.stdout.strip() or None


if __name__ == "__main__":
    sys.exit(main())
