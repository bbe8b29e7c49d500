"""The direct method's two engines, NumPy's on the host and XLA's: that they agree, how one takes
over from the other, and what a first answer compiles."""

import dataclasses
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import DoubleIntegrator, FreeTime, once, slow
from test_pseudospectral import Endless, HeldByPath

import jaxguide as jg
from jaxguide.nominal.direct import pseudospectral
from jaxguide.problem import with_array_leaves


class LeastTime(FreeTime):
    """In least time with |u| <= 1.5: one switch, half way, and no other knot to be undecided."""

    control_bounds = (-1.5, 1.5)

    def running_cost(self, t, x, u):
        return 1.0


ONE_MESH = jg.Pseudospectral(nodes=5, segments=4, refinements=0)


@pytest.mark.parametrize(
    ("problem", "method"),
    [
        (LeastTime(), dataclasses.replace(ONE_MESH, segments=2, knots=(1,))),
        slow(HeldByPath(), ONE_MESH),
        slow(Endless(), dataclasses.replace(ONE_MESH, time_scale=2.0)),
        slow(FreeTime(), dataclasses.replace(ONE_MESH, grid="lgl", smoothing=0.1)),
        slow(
            dataclasses.replace(DoubleIntegrator(), k=jg.Free(0.5, 2.0)),
            dataclasses.replace(ONE_MESH, relaxation=1e-3),
        ),
    ],
    ids=["knots", "path", "endless", "smoothed", "relaxed"],
)
def test_on_the_host_and_compiled(problem, method):
    """NumPy's engine and XLA's take the same steps, from a guess and from none."""
    problem = with_array_leaves(problem)
    start = problem.initial_state
    at = lambda x0: dataclasses.replace(problem, initial_state=x0)
    whole = once(lambda x0, g: jg.solve(at(x0), method, g, throw=False))
    host, traced = jg.solve(problem, method), whole(start, None)
    for a, b in ((host, traced), (jg.solve(problem, method, host), whole(start, host))):
        assert bool(a.result == b.result)
        for name in ("t", "x", "u", "costate", "objective"):
            one, other = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
            size = max(1.0, np.max(np.abs(one[np.isfinite(one)])))
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * size, err_msg=name)


@pytest.mark.slow
def test_iterations_begun_on_the_host_are_compiled_when_that_is_worth_it(monkeypatch):
    problem, method = LeastTime(), dataclasses.replace(ONE_MESH, segments=2, knots=(1,))
    whole, clock = jg.solve(problem, method), iter(range(1000))
    # A clock by which each reading takes a second: five iterations are worth a compilation.
    monkeypatch.setattr(
        pseudospectral, "time", SimpleNamespace(perf_counter=lambda: float(next(clock)))
    )
    monkeypatch.setattr(pseudospectral, "_on_host_so_far", {})
    cut = jg.solve(problem, method)
    for name in ("x", "u", "costate", "objective"):
        np.testing.assert_allclose(getattr(cut, name), getattr(whole, name), rtol=0, atol=1e-11)


FIRST_ANSWER = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import jaxguide as jg
from jaxguide import problems
programs = []
count = lambda event, *_, **__: "backend_compile" in event and programs.append(event)
jax.monitoring.register_event_duration_secs_listener(count)
solved = jg.solve(problems.get(sys.argv[1]), jg.Pseudospectral())
assert bool(solved.certificate.passed.all()), solved.certificate
print(len(programs))
"""


@pytest.mark.parametrize("name", ["two-thrusters", slow("earth-mars"), slow("delta-iii")])
def test_a_first_answer_compiles_few_programs(name):
    """All meshes and the certificate together compile no more than twelve programs. In a process of
    its own: this one has compiled some already."""
    command = [sys.executable, "-c", FIRST_ANSWER, name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) <= 12
