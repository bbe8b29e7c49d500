"""Every problem of the library solved from defaults, as the README's table.

Each in a process of its own: XLA keeps all its programs. Prints one line of the table when ready.
"""

import json
import os
import subprocess
import sys
import time

SMOKE = ("moon-lander", "double-integrator")
HEAD = (
    "| problem | objective | relative error | known to | mesh | certificate: rows that fail | s |"
)


def solved(name: str) -> dict:
    """One problem, solved and certified."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxguide as jg
    from jaxguide import problems

    known, start = problems.reference(name), time.perf_counter()
    extremal = jg.solve(problems.get(name), jg.Pseudospectral(), throw=False)
    elapsed = time.perf_counter() - start
    rows = extremal.certificate.rows()
    return {
        "problem": name,
        "objective": float(extremal.objective),
        "error": (float(extremal.objective) - known.value) / abs(known.value),
        "known": known.uncertainty / abs(known.value),
        "mesh": f"{len(extremal.breaks) - 1} x {extremal.degree}",
        "fails": {row["check"]: row["value"] for row in rows if not row["passed"]},
        "rows": len(rows),
        "result": jg.RESULTS[extremal.result],
        "seconds": elapsed,
    }


def line(row: dict) -> str:
    """A row of the table."""
    fails = ", ".join(f"{name} {value:.0e}" for name, value in row["fails"].items())
    return (
        f"| {row['problem']} | {row['objective']:.12g} | {row['error']:+.0e} | {row['known']:.0e} "
        f"| {row['mesh']} | {fails or 'none of ' + str(row['rows'])} | {row['seconds']:.0f} |"
    )


def main() -> None:
    arguments = sys.argv[1:]
    if arguments[:1] == ["--one"]:
        print(json.dumps(solved(arguments[1])))
        return
    from jaxguide import problems

    names = SMOKE if "--smoke" in arguments else arguments or problems.names()
    print(HEAD + "\n|" + "---|" * 7, flush=True)
    environment = {**os.environ, "EQX_ON_ERROR": "nan", "TF_CPP_MIN_LOG_LEVEL": "3"}
    worst = 0.0
    for name in names:
        command = [sys.executable, __file__, "--one", name]
        out = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        if out.returncode:
            raise SystemExit(f"{name}: {out.stderr[-2000:]}")
        row = json.loads(out.stdout.splitlines()[-1])
        print(line(row), flush=True)
        worst = max(worst, abs(row["error"]) - row["known"])
    print(f"\nworst relative error beyond the reference's uncertainty: {worst:.1e}")


if __name__ == "__main__":
    main()
