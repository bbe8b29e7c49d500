"""Direct solves from random guesses: how many converge, to which optimum, and why others do not.

    python bench/robustness.py [--smoke]

Twenty guesses each of five problems: states bent by random waves of a third of their size, random
controls, a free final time within a factor of two. Each problem in a process of its own.
"""

import collections
import os
import subprocess
import sys
import time

PROBLEMS = ("earth-mars", "brachistochrone", "van-der-pol", "moon-lander", "hanging-chain")
GUESSES = 20


def tried(name: str, guesses: int) -> None:
    """Prints one line of the table."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxguide as jg
    from jaxguide import problems

    problem, known = problems.get(name), problems.reference(name)
    certified, reasons, values = 0, collections.Counter(), collections.Counter()
    began = time.perf_counter()
    for k in range(guesses):
        found = jg.solve(problem, jg.Pseudospectral(), guess=jax.random.key(k), throw=False)
        failed = [row["check"] for row in found.certificate.rows() if not row["passed"]]
        if found.result != jg.RESULTS.successful:
            reasons[jg.RESULTS[found.result].split(":")[0]] += 1
            continue
        certified += not failed
        reasons.update({f"converged, but {check}": 1 for check in failed[:1]})
        values[f"{float(found.objective):.7g}"] += 1
    best = jg.solve(problem, jg.Pseudospectral(starts=8), throw=False)
    error = (float(best.objective) - known.value) / abs(known.value)
    at = "; ".join(f"{v} ({n})" for v, n in values.most_common())
    why = "; ".join(f"{v} ({n})" for v, n in reasons.most_common()) or "-"
    elapsed = time.perf_counter() - began
    print(f"| {name} | {certified} of {guesses} | {at} | {why} | {error:+.0e} | {elapsed:.0f} |")


def main() -> None:
    if sys.argv[1:2] == ["--one"]:
        tried(sys.argv[2], int(sys.argv[3]))
        return
    smoke = "--smoke" in sys.argv
    print("| problem | certified | objectives found | reasons | best of 8, error | s |")
    print("|" + "---|" * 6, flush=True)
    environment = {**os.environ, "EQX_ON_ERROR": "nan", "TF_CPP_MIN_LOG_LEVEL": "3"}
    for name in PROBLEMS[1:2] if smoke else PROBLEMS:
        command = [sys.executable, __file__, "--one", name, str(2 if smoke else GUESSES)]
        subprocess.run(command, env=environment, check=True)


if __name__ == "__main__":
    main()
