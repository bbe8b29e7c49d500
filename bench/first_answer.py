"""What a new user waits for: a whole process that states a problem, solves it and looks at the
certificate, nothing cached, beside a CasADi + IPOPT script of the same problem.

    python bench/first_answer.py [--smoke] [problem ...]

Ours three times over: one mesh; by default, to a certified answer; and that again in a second
process, with the programs that the first one kept. The peer is one mesh of as many nodes, built by
CasADi's symbols, solved by IPOPT to 1e-8. Also first calls of gains, flights and sweeps, and how
soon an infeasible problem says so. `--smoke` runs one problem and judges nothing; without CasADi
only our own times are printed. One JSON object on stdout; exit 1 if a limit is exceeded.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any

PROBLEMS = ("kink", "moon-lander", "earth-mars", "quadrotor", "delta-iii")
# Ratios to the peer's whole process, and compiled programs.
ONE_MESH, CERTIFIED, PROGRAMS = 16.0, 27.0, 12
# Seconds: again in a second process, a smooth problem, an infeasible one, each first call.
AGAIN, SMOOTH, INFEASIBLE, FIRST_CALL = 2.5, 2.5, 6.0, 3.0
SEGMENTS, DEGREE = 12, 6  # of our first mesh, and of the peer's

QUADROTOR_END = (2.0, 1.0, 1.5, *(0.0,) * 9)
INERTIA = (0.02, 0.025, 0.04)  # kg m^2
EFFORT = (1.0, 100.0, 100.0, 100.0)


def stated(name: str) -> Any:
    """Our Problem, as a user's script states it."""
    import jax.numpy as jnp

    import jaxguide as jg

    class Kink(jg.Problem):
        """Van der Pol's oscillator, its control bounded below: it meets the bound with a kink."""

        state_names = ("x1", "x2")
        control_names = ("u",)
        initial_state = (0.0, 1.0)
        final_time = 5.0
        control_bounds = ((-0.3,), (1.0,))

        def dynamics(self, t, x, u):
            return jnp.stack([(1 - x[1] ** 2) * x[0] - x[1] + u[0], x[0]])

        def running_cost(self, t, x, u):
            return x[0] ** 2 + x[1] ** 2 + u[0] ** 2

    class Smooth(jg.Problem):
        """A hardening spring from rest to rest."""

        state_names = ("x", "v")
        control_names = ("u",)
        initial_state = (0.0, 0.0)
        final_time = 2.0

        def dynamics(self, t, x, u):
            return jnp.stack([x[1], u[0] - x[0] ** 3])

        def running_cost(self, t, x, u):
            return 0.5 * u[0] ** 2

        def endpoint_constraints(self, x0, xf, t0, tf):
            return xf - jnp.array([1.0, 0.0])

    class Quadrotor(jg.Problem):
        """A quadrotor's twelve states from hover to hover in 3 s."""

        state_names = tuple("px py pz vx vy vz phi theta psi p q r".split())
        control_names = ("lift", "tx", "ty", "tz")
        initial_state = (0.0,) * 12
        final_time = 3.0

        def dynamics(self, t, x, u):
            return jnp.stack(quadrotor(jnp, x, u))

        def running_cost(self, t, x, u):
            return u @ (jnp.array(EFFORT) * u)

        def endpoint_constraints(self, x0, xf, t0, tf):
            return xf - jnp.array(QUADROTOR_END)

    class Walled(jg.Problem):
        """A damped spring that passes a wall which its state bound forbids."""

        state_names = ("x", "v")
        control_names = ("none",)
        control_bounds = (-1.0, 1.0)
        initial_state = (10.0, 0.0)
        final_time = 10.0
        state_bounds = ((-4.0, -jnp.inf), (jnp.inf, jnp.inf))

        def dynamics(self, t, x, u):
            return jnp.stack([x[1], -x[0] - 0.5 * x[1]])

        def running_cost(self, t, x, u):
            return u[0] ** 2

    own = {"kink": Kink, "smooth": Smooth, "quadrotor": Quadrotor, "infeasible": Walled}
    if name in own:
        return own[name]()
    from jaxguide import problems

    return problems.get(name)


def quadrotor(np: Any, x: Any, u: Any) -> list[Any]:
    """Rates of the quadrotor, in `jax.numpy` or CasADi: Euler angles, weightless when u = 0."""
    phi, theta, psi, p, q, r = (x[k] for k in range(6, 12))
    lift, (a, b, c) = 9.81 + u[0], INERTIA
    cf, sf, ct, st, cp, sp = (f(v) for v in (phi, theta, psi) for f in (np.cos, np.sin))
    turn = q * sf + r * cf
    return [
        x[3], x[4], x[5],
        (cf * st * cp + sf * sp) * lift, (cf * st * sp - sf * cp) * lift, cf * ct * lift - 9.81,
        p + turn * st / ct, q * cf - r * sf, turn / ct,
        (u[1] - (c - b) * q * r) / a, (u[2] - (a - c) * p * r) / b, (u[3] - (b - a) * p * q) / c,
    ]  # fmt: skip


def ours(name: str, how: str) -> dict[str, Any]:
    """One process of ours. `how`: "one" mesh, or to a "certified" answer."""
    import jax
    from jax import monitoring

    programs = []
    jax.config.update("jax_enable_x64", True)
    import jaxguide as jg

    problem = stated(name)
    count = lambda event, *_, **__: "backend_compile" in event and programs.append(event)
    monitoring.register_event_duration_secs_listener(count)
    direct = jg.Pseudospectral(refinements=0) if how == "one" else jg.Pseudospectral()
    method = None if name == "smooth" else direct
    try:
        extremal = jg.solve(problem, method)
    except jg.SolveError as error:
        return {"message": str(error)[:200], "programs": len(programs)}
    failing = [] if how == "one" else [r for r in extremal.certificate.rows() if not r["passed"]]
    return {
        "objective": float(extremal.objective),
        "fails": {row["check"]: row["value"] for row in failing},
        "programs": len(programs),
    }


def calls() -> dict[str, Any]:
    """Seconds of the first call of each: gains, a flight, a sweep of 10,000."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxguide as jg
    from jaxguide.problems import earth_mars

    out, began = {}, time.perf_counter()

    def done(what: str) -> None:
        nonlocal began
        out[what], began = time.perf_counter() - began, time.perf_counter()

    extremal = jg.solve(earth_mars.EarthMars())
    done("solve")
    schedule = jg.gain_schedule(extremal, jax.numpy.linspace(0.0, 3.2, 33))
    schedule.K.block_until_ready()
    done("gain_schedule")
    mission = earth_mars.mission()
    began = time.perf_counter()
    jax.block_until_ready(jg.simulate(mission).final_state)
    done("simulate")
    jg.sweep(mission, earth_mars.dispersions(), 10_000, 0)
    done("sweep")
    return out


def peer(name: str) -> dict[str, Any]:
    """The same problem as a CasADi + IPOPT script: Radau collocation, MUMPS."""
    import casadi as ca
    import numpy as np

    phases, links = _phases(name, ca, np)
    nodes = np.array(ca.collocation_points(DEGREE, "radau"))
    support = np.append(0.0, nodes)
    basis = [np.poly1d(np.poly(np.delete(support, j))) for j in range(DEGREE + 1)]
    basis = [p / p(s) for p, s in zip(basis, support, strict=True)]
    slope = np.array([[p.deriv()(s) for s in nodes] for p in basis])
    weight = np.array(
        [
            p.integ()(1.0) - p.integ()(0.0)
            for p in [
                np.poly1d(np.poly(np.delete(nodes, j)))
                / np.poly1d(np.poly(np.delete(nodes, j)))(nodes[j])
                for j in range(DEGREE)
            ]
        ]
    )
    w, start, low, high, g, g_low, g_high, J = [], [], [], [], [], [], [], 0

    def unknown(guess: Any, lo: Any, hi: Any) -> Any:
        v = ca.MX.sym("v", len(guess))
        w.append(v)
        start.extend(guess)
        low.extend(np.broadcast_to(lo, len(guess)))
        high.extend(np.broadcast_to(hi, len(guess)))
        return v

    def hold(value: Any, lo: Any = 0.0, hi: Any = 0.0) -> None:
        g.append(value)
        g_low.extend(np.broadcast_to(lo, value.shape[0]))
        g_high.extend(np.broadcast_to(hi, value.shape[0]))

    ends = []
    for p in phases:
        x, u, t = ca.SX.sym("x", p["n"]), ca.SX.sym("u", p["m"]), ca.SX.sym("t")
        f = ca.Function("f", [t, x, u], [p["f"](t, x, u), p["F"](t, x, u), p["h"](t, x, u)])
        t0, tf = (unknown([v[0]], v[1], v[2]) if isinstance(v, tuple) else v for v in p["times"])
        h = (tf - t0) / SEGMENTS
        first = xk = unknown(p["guess"](0.0), *p["start"])
        for s in range(SEGMENTS):
            at = [(s + tau) / SEGMENTS for tau in nodes]
            xs = [xk, *(unknown(p["guess"](a), *p["x"]) for a in at)]
            us = [unknown(p["control"], *p["u"]) for _ in at]
            X, U = ca.horzcat(*xs), ca.horzcat(*us)
            T = ca.horzcat(*(t0 + h * (s + tau) for tau in nodes))
            rate, cost, path = f.map(DEGREE)(T, X[:, 1:], U)
            hold(ca.vec(X @ ca.DM(slope) - h * rate))
            J += h * cost @ ca.DM(weight)
            if path.shape[0]:
                hold(ca.vec(path), -np.inf, 0.0)
            xk = xs[-1]
        ends.append((first, xk, t0, tf))
    for value in links(ends):
        hold(value)
    J += phases[-1]["E"](*ends[-1])
    nlp = {"x": ca.vertcat(*w), "f": J, "g": ca.vertcat(*g)}
    quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-8}
    solver = ca.nlpsol("s", "ipopt", nlp, quiet)
    found = solver(x0=start, lbx=low, ubx=high, lbg=g_low, ubg=g_high)
    return {"objective": float(found["f"]), "status": solver.stats()["return_status"]}


def _phases(name: str, ca: Any, np: Any) -> tuple[list[dict[str, Any]], Any]:
    """Phases of the peer's problem, and what vanishes at their ends."""
    none = lambda t, x, u: ca.SX(0, 1)
    base = {"h": none, "E": lambda *_: 0, "F": lambda t, x, u: 0, "x": (-np.inf, np.inf)}

    def straight(a: Any, b: Any) -> Any:
        return lambda s: list(np.array(a) + s * (np.array(b) - np.array(a)))

    if name == "kink":
        return [base | {
            "n": 2, "m": 1, "times": (0.0, 5.0), "start": ((0.0, 1.0), (0.0, 1.0)),
            "f": lambda t, x, u: ca.vertcat((1 - x[1] ** 2) * x[0] - x[1] + u[0], x[0]),
            "F": lambda t, x, u: ca.sumsqr(x) + ca.sumsqr(u),
            "u": (-0.3, 1.0), "control": [0.35], "guess": straight((0, 1), (0, 1)),
        }], lambda ends: []  # fmt: skip
    if name == "moon-lander":
        x0 = (10.0, -2.0)
        return [base | {
            "n": 2, "m": 1, "times": (0.0, (4.0, 0.1, 100.0)), "start": (x0, x0),
            "f": lambda t, x, u: ca.vertcat(x[1], u[0] - 1.5), "F": lambda t, x, u: u[0],
            "u": (0.0, 3.0), "control": [1.5], "guess": straight(x0, (0, 0)),
        }], lambda ends: [ends[0][1]]  # fmt: skip
    if name == "earth-mars":

        def f(t, x, u):
            a = 0.1405 / (1 - 0.0749 * t)
            return ca.vertcat(
                x[1],
                x[2] ** 2 / x[0] - 1 / x[0] ** 2 + a * ca.sin(u[0]),
                -x[1] * x[2] / x[0] + a * ca.cos(u[0]),
            )

        return [
            base
            | {
                "n": 3,
                "m": 1,
                "times": (0.0, 3.32),
                "start": ((1, 0, 1), (1, 0, 1)),
                "f": f,
                "E": lambda x0, xf, t0, tf: -xf[0],
                "x": ((0.5, -2, 0.1), (3, 2, 2)),
                "u": (-2 * np.pi, 2 * np.pi),
                "control": [1.0],
                "guess": straight((1, 0, 1), (1.5, 0, 0.8)),
            }
        ], lambda ends: [ca.vertcat(ends[0][1][1], ends[0][1][2] - 1 / ca.sqrt(ends[0][1][0]))]
    if name == "quadrotor":
        zero = (0.0,) * 12
        return [base | {
            "n": 12, "m": 4, "times": (0.0, 3.0), "start": (zero, zero),
            "f": lambda t, x, u: ca.vertcat(*quadrotor(ca, x, u)),
            "F": lambda t, x, u: ca.dot(ca.DM(EFFORT) * u, u), "u": (-np.inf, np.inf),
            "control": [0.0] * 4, "guess": straight(zero, QUADROTOR_END),
        }], lambda ends: [ends[0][1] - ca.DM(QUADROTOR_END)]  # fmt: skip
    return _ascent(base, ca, np)


def _ascent(base: dict[str, Any], ca: Any, np: Any) -> tuple[list[dict[str, Any]], Any]:
    """The four phases of `jaxguide.problems.DeltaIII`, in units of the Earth's radius, its circular
    speed and the mass on the pad."""
    d = json.loads(os.environ["ASCENT"])
    stages, R, mu = d["stages"], d["radius"], d["gravity"]
    V, M = float(np.sqrt(mu / R)), d["start"][6]
    T = R / V
    unit = np.array([R] * 3 + [V] * 3 + [M])
    omega = d["rotation"] * T

    def of(stage: Any) -> Any:
        thrust, flow = stage["thrust"] * T / (M * V), stage["flow"] * T / M
        drag = 0.5 * stage["density"] * d["drag_area"] * R / M

        def f(t, x, u):
            r, v, m = x[:3], x[3:6], x[6]
            wind = ca.vertcat(-r[1], r[0], 0) * omega
            through, distance = v - wind, ca.sqrt(ca.sumsqr(r))
            speed = ca.sqrt(ca.sumsqr(through) + 1e-6 / V**2)
            air = ca.exp(-ca.fmax(distance - 1, 0) * R / d["scale_height"])
            pull = -drag * air * speed * through
            return ca.vertcat(v, (thrust * u + pull) / m - r / distance**3, -flow)

        return f

    start = np.array(d["start"]) / unit
    size = float(np.linalg.norm(d["momentum"]))
    times = [0.0, *(c / T for c in d["times"])]
    final = (900.0 / T, times[-1], d["latest"] / T)
    masses, phases = [start[6]], []
    dry = [m / M for m in d["dropped"]]
    up = start[:3] / np.linalg.norm(start[:3])
    for i, stage in enumerate(stages):
        a, b = times[i], times[i + 1] if i < 3 else final
        end = b if i < 3 else final[0]
        before = masses[-1]
        after = before - stage["flow"] * T / M * (end - a)
        masses.append(after - (dry[i] if i < 3 else 0.0))
        x_a, x_b = start.copy(), start.copy()
        x_a[:3], x_b[:3] = up * (1 + 0.01 * i), up * (1 + 0.01 * (i + 1))
        x_a[3:6] += 0.25 * i * np.array([0, 1, 0])
        x_b[3:6] += 0.25 * (i + 1) * np.array([0, 1, 0])
        x_a[6], x_b[6] = before, after
        box = (np.array([-2.0] * 3 + [-2.0] * 3 + [1e-3]), np.array([2.0] * 3 + [2.0] * 3 + [1.05]))
        phases.append(base | {
            "n": 7, "m": 3, "times": (a, b), "start": (start, start) if i == 0 else box, "x": box,
            "f": of(stage), "u": (-3.0, 3.0), "control": [0.0, 0.9, 0.3],
            "h": lambda t, x, u: ca.sumsqr(u) - 1, "E": lambda x0, xf, t0, tf: -xf[6],
            "guess": (lambda a, b: lambda s: list(a + s * (b - a)))(x_a, x_b),
        })  # fmt: skip

    def links(ends: list[Any]) -> list[Any]:
        out = [
            b[0] - a[1] + ca.vertcat(*(0,) * 6, m)
            for a, b, m in zip(ends[:-1], ends[1:], dry, strict=True)
        ]
        r, v = ends[-1][1][:3] * R, ends[-1][1][3:6] * V
        h = ca.cross(r, v)
        e = ca.cross(v, h) / mu - r / ca.sqrt(ca.sumsqr(r))
        along, across = ca.dot(e, ca.DM(d["perigee"])), ca.dot(e, ca.DM(d["across"]))
        turn = (h - ca.DM(d["momentum"])) / size
        return [*out, ca.vertcat(turn, along - d["eccentricity"], across)]

    return phases, links


def ascent() -> str:
    """The numbers of `jaxguide.problems.DeltaIII`, for a peer that does not import it."""
    import numpy as np

    from jaxguide.problems import delta_iii as d

    stages = d.stages()
    momentum, perigee, across = (a.tolist() for a in d.orbit())
    dry = lambda part, count: count * (part[0] - part[1])
    return json.dumps({
        "stages": [
            {k: float(getattr(s, k)) for k in ("thrust", "flow", "density")} for s in stages
        ],
        "start": [float(v) for v in stages[0].initial_state],
        "times": [float(np.ravel(s.final_time)[0]) for s in stages[:3]],
        "latest": float(stages[3].final_time.hi), "radius": d._RADIUS, "gravity": d._GRAVITY,
        "rotation": d._ROTATION, "drag_area": d._DRAG_AREA, "scale_height": d._SCALE_HEIGHT,
        "dropped": [dry(d._BOOSTER, 6), dry(d._BOOSTER, 3), dry(d._FIRST, 1)],
        "momentum": momentum, "perigee": perigee, "across": across, "eccentricity": d._ORBIT[1],
    })  # fmt: skip


def whole(*arguments: str, **environment: str) -> dict[str, Any]:
    """A process of this file, with its seconds."""
    began = time.perf_counter()
    command = [sys.executable, __file__, *arguments]
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"} | environment
    run = subprocess.run(command, env=env, capture_output=True, text=True)
    seconds = time.perf_counter() - began
    if run.returncode:
        return {"s": seconds, "error": run.stderr.strip()[-300:]}
    return {"s": seconds, **json.loads(run.stdout.splitlines()[-1])}


def compared(name: str, has_peer: bool) -> dict[str, Any]:
    """Ours and the peer's processes of one problem. What a first process keeps, a second one finds
    in a folder of its own."""
    with tempfile.TemporaryDirectory() as kept:
        out = {
            "one_mesh": whole("--ours", name, "one", JAXGUIDE_CACHE_DIR=""),
            "certified": whole("--ours", name, "certified", JAXGUIDE_CACHE_DIR=kept),
            "again": whole("--ours", name, "certified", JAXGUIDE_CACHE_DIR=kept),
        }
    if has_peer:
        numbers = {"ASCENT": ascent()} if name == "delta-iii" else {}
        peers = [whole("--peer", name, **numbers) for _ in range(2)]
        out["peer"] = min(peers, key=lambda r: r["s"])
        for what in ("one_mesh", "certified"):
            out[what]["ratio"] = out[what]["s"] / out["peer"]["s"]
    return out


def judged(found: dict[str, dict[str, Any]]) -> dict[str, bool]:
    """Which limits hold."""
    within = {}
    for name, runs in found.items():
        if name in ("smooth", "infeasible", "calls"):
            continue
        certified = runs["certified"]
        within[f"{name}: certified"] = not certified.get("fails", True)
        within[f"{name}: programs"] = certified.get("programs", 99) <= PROGRAMS
        within[f"{name}: again"] = runs["again"]["s"] <= AGAIN
        if "peer" in runs:
            within[f"{name}: one mesh"] = runs["one_mesh"]["ratio"] <= ONE_MESH
            within[f"{name}: certified in time"] = certified["ratio"] <= CERTIFIED
    if "smooth" in found:
        within["smooth"] = found["smooth"]["s"] <= SMOOTH
        within["infeasible"] = found["infeasible"]["s"] <= INFEASIBLE
        for what in ("gain_schedule", "simulate", "sweep"):
            within[what] = found["calls"].get(what, 99.0) <= FIRST_CALL
    return within


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--ours", nargs=2)
    parser.add_argument("--peer")
    parser.add_argument("--calls", action="store_true")
    given = parser.parse_args()
    if given.ours or given.peer or given.calls:
        asked = ours(*given.ours) if given.ours else calls() if given.calls else peer(given.peer)
        print(json.dumps(asked))
        return 0
    try:
        import casadi  # noqa: F401

        has_peer = True
    except ImportError:
        has_peer = False
    names = given.names or (PROBLEMS[:1] if given.smoke else PROBLEMS)
    found = {name: compared(name, has_peer) for name in names}
    if not given.names and not given.smoke:
        off = {"JAXGUIDE_CACHE_DIR": ""}
        found["smooth"] = whole("--ours", "smooth", "certified", **off)
        found["infeasible"] = whole("--ours", "infeasible", "certified", **off)
        found["calls"] = whole("--calls", **off)
    within = judged(found)
    print(json.dumps({"bench": "first_answer", **found, "within": within}, indent=1))
    return 0 if given.smoke or all(within.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
