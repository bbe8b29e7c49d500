"""Direct solves against CasADi + IPOPT: same nodes, tolerance and guess, in one run.

    python bench/pseudospectral.py [--smoke]

The peer, `ocp_casadi.py`, is looked for beside the checkout (`../shared/bench`) or at
$JAXGUIDE_PEERS; without it or CasADi only our own times are printed. One JSON object on stdout.
"""

import argparse
import dataclasses
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):  # for IPOPT's MUMPS as for us
    os.environ.setdefault(name, "1")
import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from gains import PEERS, best_of, cold  # noqa: E402

import jaxguide as jg  # noqa: E402
from jaxguide import problems  # noqa: E402
from jaxguide.host.compilation import quick_compilation  # noqa: E402
from jaxguide.nominal.direct import interior_point  # noqa: E402
from jaxguide.nominal.direct.collocation import collocation  # noqa: E402
from jaxguide.nominal.direct.limits import limits_of  # noqa: E402
from jaxguide.problem import with_array_leaves  # noqa: E402

TRUTH = 1.525277700649  # r_f of Earth-Mars
# Earth-Mars on a fixed mesh that meets 1e-9: half of its segments where the thrust turns over.
BREAKS = (*np.linspace(0, 0.40, 4), *np.linspace(0.40, 0.62, 7)[1:], *np.linspace(0.62, 1, 4)[1:])
FINE = jg.Pseudospectral("lgr-right", 12, 12, fractions=BREAKS, refinements=0)


def stated(name: str) -> tuple[Any, Any, Any, Any, float]:
    """Our Problem as the peer states it, the peer's units of state and control, its guess of tf."""
    p = problems.get(name)
    if name == "earth-mars":
        box = ((0.5, -2.0, 0.1), (3.0, 2.0, 2.0))
        p = dataclasses.replace(p, state_bounds=box, control_bounds=(-2 * np.pi, 2 * np.pi))
        return p, 1.0, 1.0, "earth_mars", 3.32
    if name == "npsat1":
        units = np.array([1, 1, 1, 1, 0.01, 0.01, 0.05])
        return p, units, 33.0, "npsat1", 120.0
    p = dataclasses.replace(
        p, gravity=9.81, state_bounds=(0.0, 20.0), control_bounds=(0.0, np.pi),
        final_time=jg.Free(0.1, 20.0, 2.0),
    )  # fmt: skip
    return p, 1.0, 1.0, "brach", 2.0


def one_solve(name: str, N: int, tolerance: float, peer: Any, repeats: int) -> dict[str, Any]:
    """N + 1 LGL nodes from the peer's guess, warm; in turn with the peer."""
    problem, unit_x, unit_u, theirs, tf = stated(name)
    method = jg.Pseudospectral("lgl", N + 1, 1, tolerance=tolerance)
    problem = with_array_leaves(problem)
    s = (collocation("lgl", N + 1).nodes + 1) / 2
    p = getattr(peer, theirs)() if peer else None
    x, u = (np.asarray(a) for a in p.guess(s)) if p else (None, None)

    def prepare(problem: Any) -> Any:
        program, start, _ = method.prepared(problem, None)
        if x is None or u is None:
            return program, start
        w = start.w
        units = program.units
        w = w._replace(
            x=jnp.asarray((x * unit_x)[None, 1:]) / units.x,
            u=jnp.asarray(u[None] * unit_u) / units.u,
            times=w.times.at[1].set(tf / program.scale.t),
        )
        node, end = program.values(w)
        return program, start._replace(w=w._replace(path=node[:, :, problem.n + 1 :], end=end[1:]))

    program, w = jax.jit(prepare)(problem)

    def run(program: Any, w: Any) -> Any:
        options = interior_point.Options(tolerance, 0.1, 500, 1e-2, False)
        sol = interior_point.minimise(program, limits_of(program), w, options)
        f, _ = program.objective_and_residual(sol.w)
        return sol.status, sol.iterations, f * program.scale.objective

    quick = jax.jit(run, compiler_options=quick_compilation() or None)
    _, quickly = cold(lambda: quick(program, w))
    compiled = jax.jit(run)  # as with quick=False
    (status, iterations, f), first = cold(lambda: compiled(program, w))
    out = {
        "converged": int(status) == interior_point.CONVERGED, "iterations": int(iterations),
        "objective": float(f), "compile_s": first, "compile_quick_s": quickly,
        "quick_s": best_of(lambda: quick(program, w), repeats),
    }  # fmt: skip
    seconds = [best_of(lambda: compiled(program, w), repeats)]
    if peer:
        record, _ = peer.run(theirs, p, N, repeats, tolerance)
        seconds.append(best_of(lambda: compiled(program, w), repeats))
        out |= {
            "ipopt_s": record["min_s"], "ipopt_iterations": record["iterations"],
            "ipopt_objective": record["objective"], "ipopt_build_s": record["build_s"],
        }  # fmt: skip
        out["share_of_ipopt"] = min(seconds) / record["min_s"]
    return out | {"s": min(seconds)}


def batch(count: int, N: int, tolerance: float, peer: Any) -> dict[str, Any]:
    """Earth-Mars with thrusts within 2 %, each from the nominal solution; the peer likewise."""
    nominal = jg.solve(problems.EarthMars())
    thrusts = 0.1405 * (1 + 0.02 * np.linspace(-1, 1, count))
    many = jax.vmap(lambda k: dataclasses.replace(problems.EarthMars(), thrust=k))(thrusts)
    out: dict[str, Any] = {"problems": count}
    coarse = jg.Pseudospectral("lgr-right", 6, 6, tolerance=tolerance, quick=False, refinements=0)
    for name, method in {
        f"LGL {N}": jg.Pseudospectral(
            "lgl", N + 1, 1, tolerance=tolerance, quick=False, refinements=0
        ),
        "LGR 6 x 6": coarse,
    }.items():
        solved, first = cold(lambda m=method: jg.solve_batch(many, m, nominal))
        _, warm = cold(lambda m=method: jg.solve_batch(many, m, nominal))
        at = jg.solve(problems.EarthMars(), dataclasses.replace(method, refinements=0), nominal)
        out[name] = {
            "converged": int(np.sum(np.asarray(solved.result == jg.RESULTS.successful))),
            "first_s": first, "s": warm, "a_second": count / warm,
            "error_of_nominal": float(-at.objective - TRUTH),
        }  # fmt: skip
    if peer:
        p = peer.earth_mars()
        p.guess = lambda s: (
            np.asarray(nominal(jnp.asarray(3.32 * s)).x),
            np.asarray(nominal(jnp.asarray(3.32 * s)).u),
        )
        solver, args, *_ = peer.build(p, N, tolerance)
        began, some = time.perf_counter(), max(count // 8, 1)
        for _ in range(some):  # its program holds the thrust as a constant: the same each time
            solver(**args)
        rate = some / (time.perf_counter() - began)
        out |= {"ipopt_a_second": rate, "ipopt_iterations": int(solver.stats()["iter_count"])}
        for name in out:
            if isinstance(out[name], dict):
                out[name]["times_ipopt"] = out[name]["a_second"] / rate
    return out


def slope_share(repeats: int) -> dict[str, float]:
    """d r_f/d thrust beside the solve itself, on LGR 12 x 6."""
    method = jg.Pseudospectral("lgr-right", 12, 6, refinements=0)
    at = lambda k: (
        jg.solve(dataclasses.replace(problems.EarthMars(), thrust=k), method, throw=False).objective
    )
    alone, both = jax.jit(at), jax.jit(jax.value_and_grad(at))
    one, two = best_of(lambda: alone(0.1405), repeats), best_of(lambda: both(0.1405), repeats)
    one = min(one, best_of(lambda: alone(0.1405), repeats))
    return {"solve_s": one, "gradient_share": two / one - 1, "slope": float(-both(0.1405)[1])}


def accurate(repeats: int) -> dict[str, float]:
    """Earth-Mars to 1e-9 on a fixed mesh."""
    problem = problems.EarthMars()
    run = jax.jit(lambda p: jg.solve(p, FINE, throw=False).objective)
    p = with_array_leaves(problem)
    seconds = best_of(lambda: run(p), repeats)
    return {"error": float(-run(p) - TRUTH), "s": seconds}


_CHILD = """
import time, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # as the commands do
import jaxguide as jg
from jaxguide.problems import EarthMars
began = time.perf_counter()
jg.solve(EarthMars(), jg.Pseudospectral(refinements=0))
print(time.perf_counter() - began)
"""


def first_solve() -> dict[str, float]:
    """The first `jg.solve` of a new process, without and with the persistent cache."""
    with tempfile.TemporaryDirectory() as cache:
        env = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache, "EQX_ON_ERROR": "nan", "TF_CPP_MIN_LOG_LEVEL": "3",
        }  # fmt: skip
        run = lambda: float(
            subprocess.run(
                [sys.executable, "-c", _CHILD], env=env, capture_output=True, text=True, check=True
            ).stdout
        )
        return {"cold_s": run(), "from_cache_s": run()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="few repeats, small, no peer")
    smoke = parser.parse_args().smoke
    repeats, tolerance, peer = (1 if smoke else 15), 1e-8, None
    out: dict[str, Any] = {"jax": jax.__version__, "device": str(jax.devices()[0]), "peer": "none"}
    if not smoke and (PEERS / "ocp_casadi.py").exists():
        sys.path.insert(0, str(PEERS))
        try:
            peer = importlib.import_module("ocp_casadi")
            out["peer"] = f"CasADi {importlib.import_module('casadi').__version__} + IPOPT"
        except ImportError as e:
            out["peer"] = f"none: {e}"
    if smoke:
        out["earth-mars LGL 12"] = one_solve("earth-mars", 12, tolerance, None, repeats)
        out["batch"] = batch(4, 12, tolerance, None)
    else:
        for name in ("earth-mars", "brachistochrone-dymos", "npsat1"):
            for N in (32, 64):
                out[f"{name} LGL {N}"] = one_solve(name, N, tolerance, peer, repeats)
        out["batch"] = batch(256, 32, tolerance, peer)
        out["gradient"] = slope_share(repeats)
        out["accurate"] = accurate(repeats)
        out["compile"] = first_solve()
    json.dump(out, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
