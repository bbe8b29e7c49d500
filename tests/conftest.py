"""Settings of every test, and the solved problems that tests share: each costs seconds to compile,
so tests perturb these (`dataclasses.replace` keeps the compiled program) and make few of their own.
"""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportAssignmentType=false

import os
from functools import partial

import equinox as eqx
import jax
import matplotlib

# Compiles in half the time, for code a fifth slower: tests compile for minutes and run for seconds.
# Benchmarks and the commands that tests start go without.
_QUICK = "--xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_QUICK}".strip()
jax.devices()
os.environ["XLA_FLAGS"] = os.environ["XLA_FLAGS"].replace(_QUICK, "").strip()

# Programs kept between runs would hide what is compiled, and those of the option above would be
# taken for others: nothing is kept, but by the tests of keeping.
os.environ["JAXGUIDE_CACHE_DIR"] = ""

matplotlib.use("Agg")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

import jaxguide as jg  # noqa: E402
from jaxguide.nominal.direct import pseudospectral  # noqa: E402
from jaxguide.problems.earth_mars import EarthMars  # noqa: E402

# Iterations on the host take the longer the more tests share its cores, and compiling them instead
# takes as much longer: they are left there, but by the tests of compiling them.
pseudospectral._WORTH_COMPILING = 60.0


def slow(*values):
    """Parameters of a case that the default run leaves to the slow one."""
    return pytest.param(*values, marks=pytest.mark.slow)


# For programs that run once or twice: as they are written they compile in two thirds of the time.
AS_WRITTEN = {"xla_backend_optimization_level": 0}
once = partial(jax.jit, compiler_options=AS_WRITTEN)

# Few starts, one coarse mesh: enough for problems whose extremal is unique and smooth.
SMALL = jg.Shooting(arcs=2, segments=8, starts=4)


class DoubleIntegrator(jg.Problem):
    """x'' = k u, J = int u^2/2, to C x = target. From rest over unit distance and time with
    k = 1: u = 6 - 12 t, J = 6; the gain is (-6/T^2, -4/T), T the time left."""

    k: float = 1.0
    target: tuple = (1.0, 0.0)
    C: tuple = (1.0, 0.0, 0.0, 1.0)  # by rows; identity
    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 0.0)

    def dynamics(self, t, x, u):
        return jnp.stack([x[1], self.k * u[0]])

    def running_cost(self, t, x, u):
        return 0.5 * u[0] ** 2

    def endpoint_constraints(self, x0, xf, t0, tf):
        return jnp.stack(self.C).reshape(2, 2) @ xf - jnp.stack(self.target)


class FreeTime(DoubleIntegrator):
    """As above with J = int (1 + u^2/2) and the final time free: tf = 18^(1/4) from rest."""

    final_time = jg.Free(0.2, 20.0, 2.0)

    def running_cost(self, t, x, u):
        return 1.0 + 0.5 * u[0] ** 2


class ForcedLQR(jg.Problem):
    """x' = a x + u + d sin t, y' = y t/2, y(0) free, no endpoint constraint;
    J = s x_f^2/2 + (y_f - 2)^2/2 + y_0^2/2 + int (q x^2 + u^2)/2 + c x cos t.

    K = (-S(t), 0) with S of the scalar Riccati equation; y_0 = 2 g/(1 + g^2), g = y_f/y_0.
    """

    a: float = 0.5
    q: float = 2.0
    s: float = 0.3
    c: float = 1.0
    d: float = 0.8
    state_names = ("x", "y")
    control_names = ("u",)
    initial_time = 0.5
    final_time = 2.0
    initial_state = (1.0, jg.Free())

    def dynamics(self, t, x, u):
        return jnp.stack([self.a * x[0] + u[0] + self.d * jnp.sin(t), x[1] * t / 2])

    def running_cost(self, t, x, u):
        return 0.5 * (self.q * x[0] ** 2 + u[0] ** 2) + self.c * x[0] * jnp.cos(t)

    def endpoint_cost(self, x0, xf, t0, tf):
        return 0.5 * (self.s * xf[0] ** 2 + (xf[1] - 2) ** 2 + x0[1] ** 2)


class Regulator(jg.Problem):
    """Two uncoupled x_i' = a_i x_i + u_i to 0, J = int sum (q_i x_i^2 + r_i u_i^2)/2.

    With r = 1 and w = sqrt(a^2 + q): K_i = -(a_i + w_i coth(w_i T)); for a = 0, q = -w^2 it is
    -w cot(w T), with a conjugate point at T = pi/w.
    """

    a: tuple = (0.0, 0.0)
    q: tuple = (0.0, 0.0)
    r: tuple = (1.0, 1.0)
    state_names = ("x", "y")
    control_names = ("u", "v")
    initial_state = (1.0, 0.5)

    def dynamics(self, t, x, u):
        return jnp.stack(self.a) * x + u

    def running_cost(self, t, x, u):
        return 0.5 * jnp.sum(jnp.stack(self.q) * x**2 + jnp.stack(self.r) * u**2)

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf


class Zermelo(jg.Problem):
    """Shortest time across the shear current (-V y/h, 0) to the origin, heading free.

    **Source:** Bryson & Ho (1975), section 2.7, example 1, whose solution is in closed form.
    """

    V: float = 1.0
    h: float = 1.0
    state_names = ("x", "y")
    control_names = ("heading",)
    initial_state = (3.66, -1.86)
    final_time = jg.Free(0.5, 20.0, 4.0)

    def dynamics(self, t, x, u):
        current = -self.V * x[1] / self.h
        return jnp.stack([self.V * jnp.cos(u[0]) + current, self.V * jnp.sin(u[0])])

    def running_cost(self, t, x, u):
        return jnp.ones(())

    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf


def zermelo_to_go(heading, end, xp=np):
    """Position from which Zermelo's problem (V = h = 1) is left with `heading`, reaching the
    origin with `end`; both point upstream (cos < 0). The time to go is tan(end) - tan(heading).

    tan(heading) grows with time at V/h; the rest is quadrature of the sine and cosine.
    **Source:** Bryson & Ho (1975), section 2.7.
    """
    a, b = xp.tan(heading), xp.tan(end)
    sec_a, sec_b = 1 / xp.cos(heading), 1 / xp.cos(end)
    x = xp.arcsinh(b) - xp.arcsinh(a) - sec_b * (b - a) + a * (sec_b - sec_a)
    return xp.stack([x / 2, sec_a - sec_b])


# Called op by op these compile for seconds each; as one program, once for each kind of object.
at = eqx.filter_jit(lambda extremal, t: extremal(t))
gain = eqx.filter_jit(lambda schedule, t: schedule(t))
history = eqx.filter_jit(lambda schedule, t_k, t: schedule.history(t_k, t))


def flags(schedule):
    """The reason of every time, as a list of names."""
    names = ("successful", "gain_unresolved", "conjugate_point", "not_minimising")
    codes = np.asarray(schedule.result._value)
    code = {int(getattr(jg.RESULTS, name)._value): name for name in names}
    return [code[int(c)] for c in codes]


@pytest.fixture(scope="session")
def earth_mars():
    return jg.solve(EarthMars(), jg.Shooting(starts=8))


@pytest.fixture(scope="session")
def double_integrator():
    return jg.solve(DoubleIntegrator(), SMALL)


@pytest.fixture(scope="session")
def free_time():
    return jg.solve(FreeTime(), SMALL)


@pytest.fixture(scope="session")
def lqr():
    return jg.solve(ForcedLQR(), SMALL)


@pytest.fixture(scope="session")
def regulator():
    return jg.solve(Regulator(), SMALL)


@pytest.fixture(scope="session")
def zermelo():
    return jg.solve(Zermelo(), jg.Shooting(arcs=2, segments=16, starts=16))


@pytest.fixture(scope="session")
def schedule(earth_mars):
    """The paper's 166 samples."""
    return jg.gain_schedule(earth_mars, np.arange(166) * 0.02)


@pytest.fixture
def compilations():
    """Counts XLA compilations since the test began; call it."""
    count = [0]

    def listen(event, duration, **kwargs):
        count[0] += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield lambda: count[0]
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(autouse=True, scope="module")
def release_compiled_programs():
    """Thousands of compiled programs in one process exhaust its memory maps and abort it."""
    yield
    jax.clear_caches()
