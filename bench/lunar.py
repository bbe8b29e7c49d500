"""Dispersed lunar launches a second, the law searching for its reference time at every sample,
against a NumPy loop of the same law.

    python bench/lunar.py [--smoke]

Thesis's law: 4 s samples, one RK4 step each, the time to go decides the end. Both fly the same
cases and must agree. One JSON object on stdout.
"""

import argparse
import json
import sys
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jaxguide as jg  # noqa: E402
from jaxguide.laws.gain_interpolation import LinearGains  # noqa: E402
from jaxguide.problems import lunar_launch  # noqa: E402

INTERVAL, END = 4.0, 1e-6


class Loop:
    """The thesis's closed loop, one flight at a time, in NumPy."""

    def __init__(self, law: Any):
        s = law.schedule
        self.nodes, self.stations = np.asarray(s.positions), np.asarray(s.stations)
        self.controls, self.polynomials = np.asarray(s.controls)[:, 0], np.asarray(s.polynomials)
        self.here, self.ahead = np.asarray(s.here)[:, 0], np.asarray(s.ahead)[:, 0]
        self.time, self.spacing = np.asarray(s.K_time), np.asarray(s.spacing)
        self.tf = float(s.duration)

    def interval(self, tau: float) -> int:
        return min(max(int(np.searchsorted(self.nodes, tau, "right")) - 1, 0), len(self.nodes) - 2)

    def control(self, t: float) -> float:
        i = self.interval(t / self.tf)
        a, b = self.nodes[i], self.nodes[i + 1]
        return self.controls[i] + (t / self.tf - a) / (b - a) * (
            self.controls[i + 1] - self.controls[i]
        )

    def state(self, t: float) -> np.ndarray:
        i = self.interval(t / self.tf)
        a, b = self.nodes[i], self.nodes[i + 1]
        local, value = (2 * t / self.tf - a - b) / (b - a), self.polynomials[i, 0]
        for term in self.polynomials[i, 1:]:
            value = value * local + term
        return value

    def gain(self, values: np.ndarray, t: float) -> Any:
        tau, s = t / self.tf, self.stations
        i = min(max(int(np.searchsorted(s, tau, "right")) - 1, 0), len(s) - 2)
        return values[i] + (tau - s[i]) / (s[i + 1] - s[i]) * (values[i + 1] - values[i])

    def reference(self, x: np.ndarray, guess: float) -> float:
        """By secants, from where the last one leads."""
        change = lambda t: self.gain(self.time, t) @ (x - self.state(t))
        a, b = guess, guess + 0.01
        fa, fb = change(a), change(b)
        for _ in range(20):
            if fb == fa or abs(b - a) < 1e-12 * self.tf:
                break
            a, b, fa = b, b - fb * (b - a) / (fb - fa), fb
            fb = change(b)
        return b

    def fly(self, x: np.ndarray, thrust: float, gravity: float) -> tuple[float, np.ndarray]:
        t = t0 = 0.0
        for _ in range(200):
            t0 = self.reference(x, t0)
            left = self.tf - t0
            if abs(left) < END:
                break
            dx, h = x - self.state(t0), min(INTERVAL, left)
            du, ahead = self.gain(self.here, t0) @ dx, self.gain(self.ahead, t0) @ dx
            slope = (ahead - du) / (self.gain(self.spacing, t0) * self.tf)

            def rate(s: float, x: np.ndarray, t0=t0, du=du, slope=slope) -> np.ndarray:
                u = self.control(t0 + s) + du + slope * s
                return np.array([x[2], x[3], thrust * np.cos(u), thrust * np.sin(u) - gravity])

            k1 = rate(0.0, x)
            k2 = rate(h / 2, x + h / 2 * k1)
            k3 = rate(h / 2, x + h / 2 * k2)
            k4 = rate(h, x + h * k3)
            x, t, t0 = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), t + h, t0 + h
            if left < 0:
                break
        return t, x


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="few flights")
    smoke = parser.parse_args().smoke
    cases, by_hand = (4096, 4) if smoke else (100_000, 50)
    loop = lunar_launch.mission(form="whole", interpolation=LinearGains(), quiet=0.0, miss=None)
    sweep = jg.sweep(loop, lunar_launch.dispersions(), cases, 0)
    draws = {k: np.asarray(sweep[f"draw:{k}"]) for k in lunar_launch.dispersions()}
    numpy_loop = Loop(loop.law)
    plant: Any = loop.plant
    numpy_loop.fly(np.zeros(4), float(plant.thrust), float(plant.gravity))  # warm
    began, worst = time.perf_counter(), 0.0
    for k in range(by_hand):
        t, x = numpy_loop.fly(
            np.asarray(sweep["initial_state"])[k],
            float(plant.thrust) + draws["plant.thrust"][k],
            float(plant.gravity) + draws["plant.gravity"][k],
        )
        worst = max(worst, float(np.abs(x - np.asarray(sweep["final_state"])[k]).max()))
    rate = by_hand / (time.perf_counter() - began)
    one = eqx.filter_jit(lambda m: jg.simulate(m, None, "ends").final_time)
    jax.block_until_ready(one(loop))
    began = time.perf_counter()
    for _ in range(20):
        jax.block_until_ready(one(loop))
    single = (time.perf_counter() - began) / 20
    out = {
        "jax": jax.__version__,
        "device": str(jnp.zeros(()).device),
        "dtype": "float64",
        "flights": cases,
        "compile_s": sweep.attrs["compile_s"],
        "flights_per_s": sweep.attrs["rollouts_per_s"],
        "numpy_flights_per_s": rate,
        "ratio": sweep.attrs["rollouts_per_s"] / rate,
        "one_flight_s": single,
        "worst_difference_of_final_state": worst,
        "failures": sweep.attrs["failures"],
    }
    json.dump(out, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
