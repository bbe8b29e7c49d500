"""What decides a program is told without tracing it: `jaxguide.host.fingerprint`. A change that the
digest does not show would run an old program, so each kind of change is made here."""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false

import dataclasses
import json
import os
import subprocess
import sys

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxguide as jg
from jaxguide.host import cache, fingerprint
from jaxguide.host.fingerprint import Untold, told

# A function of a known package. This one's own are checked by beartype here, in wrappers.
KNOWN = jax.tree_util.tree_map

# A user's module, as text: each change below is made to it, and the module run again.
MODULE = """
import dataclasses, equinox as eqx, jax, jax.numpy as jnp, numpy as np, jaxguide as jg
DRAG = 0.1
TABLE = np.linspace(0.0, 1.0, 5)

@jax.custom_jvp
def own(v):
    return v * v
own.defjvp(lambda primals, tangents: (own(*primals), 2 * primals[0] * tangents[0]))

def scale(v):
    return 1.5 * v

class Engine(eqx.Module):
    thrust: float = 2.0
    def force(self, u):
        return self.thrust * u

class P(jg.Problem):
    mass: jax.Array
    label: str = eqx.field(static=True, default="a")
    engine: Engine = Engine()
    state_names = ("x", "v")
    control_names = ("u",)
    final_time = 2.0
    control_bounds = (-1.0, 1.0)
    @property
    def initial_state(self):
        return (0.5, 0.0)
    def dynamics(self, t, x, u):
        push = self.engine.force(u[0]) - DRAG * x[1] + jnp.interp(t, TABLE, TABLE)
        return jnp.stack([x[1], scale(push) / self.mass])
    def running_cost(self, t, x, u):
        return u[0] ** 2
    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf

def links(ends):
    return ends[1].x0 - ends[0].xf

problem = P(jnp.asarray(1.0))
whole = jg.Phased((problem, dataclasses.replace(problem, final_time=4.0)), links=links)
"""

CHANGES = {
    "a number in a function": ("1.5 * v", "1.6 * v"),
    "an operation": ("u[0] ** 2", "u[0] ** 4"),
    "a global number": ("DRAG = 0.1", "DRAG = 0.2"),
    "a global table": ("np.linspace(0.0, 1.0, 5)", "np.linspace(0.0, 2.0, 5)"),
    "a part's method": ("self.thrust * u", "self.thrust * u * u"),
    "a part's number": ("thrust: float = 2.0", "thrust: float = 3.0"),
    "a static field": ('default="a"', 'default="b"'),
    "a bound": ("(-1.0, 1.0)", "(-1.0, 2.0)"),
    "a property": ("(0.5, 0.0)", "(0.6, 0.0)"),
    "a name": ('"v")', '"w")'),
    "a final time": ("final_time = 2.0", "final_time = jg.Free(1.0, 3.0)"),
    "constraints": ("return xf\n", "return xf[:1]\n"),
    "the links": ("ends[1].x0 - ends[0].xf", "ends[1].x0 - 2 * ends[0].xf"),
    "a class": ("class P(", "class Q(jg.Problem):\n    pass\n\nclass P("),  # none: nothing changes
}


def module(text):
    """The user's module that `text` makes."""
    names = {"__name__": "__main__"}
    exec(compile(text, "script.py", "exec"), names)
    return names


def digest(text, name="whole"):
    return told(KNOWN, (module(text)[name], np.zeros(3)))


@pytest.mark.parametrize("change", CHANGES)
def test_what_changes_a_program_changes_its_digest(change):
    old, new = CHANGES[change]
    assert MODULE.count(old) == 1
    assert digest(MODULE) == digest(MODULE)
    assert (digest(MODULE) == digest(MODULE.replace(old, new))) == (change == "a class")


def test_functions_that_change_within_a_process_are_untold():
    """JAX keeps traces of parts with the old number: a program of both would be kept."""
    names = module(MODULE)
    told(KNOWN, names["problem"])
    names["DRAG"] = 0.2
    with pytest.raises(Untold):
        told(KNOWN, names["problem"])
    names["DRAG"] = 0.1
    told(KNOWN, names["problem"])


def test_numbers_that_a_program_takes_do_not():
    a, b = (module(MODULE.replace("jnp.asarray(1.0)", f"jnp.asarray({v})")) for v in (1.0, 2.0))
    same = [told(KNOWN, (m["problem"], np.full(3, k))) for k, m in enumerate((a, b))]
    assert same[0] == same[1]
    assert same[0] != told(KNOWN, (a["problem"], np.zeros(4)))
    assert told(KNOWN, 1) != told(KNOWN, 1.0)


class Own(eqx.Module):
    """A kind that the package does not know."""


@pytest.mark.parametrize(
    "old, new",
    [
        ("return v * v", "jax.debug.print('{}', v); return v * v"),
        ("1.5 * v", "own(v)"),  # its rule may be anything
        ("1.5 * v", "jax.pure_callback(np.sin, v, v)"),
        ('default="a"', "default=(lambda: 1)"),
        ('default="a"', "default=object()"),
    ],
)
def test_what_is_not_understood_is_untold(old, new):
    text = MODULE.replace(old, new)
    if old == "return v * v":
        text = text.replace("1.5 * v", "own(v)")
    with pytest.raises(Untold):
        digest(text)


def test_others_are_untold():
    decorated = jax.jit(lambda x: x)
    around = lambda f: (lambda g: setattr(g, "__wrapped__", f) or g)(lambda *a: 2 * f(*a))
    for function in (decorated, lambda x: x, around(KNOWN), digest):
        with pytest.raises(Untold):
            told(function, 1)
    for value in (Own(), object(), around(KNOWN), {1, 2}):
        with pytest.raises(Untold):
            told(KNOWN, value)


def test_a_known_rule_of_differentiation_is_told():
    assert digest(MODULE.replace("1.5 * v", "jg.sincos(v)[0]")) != digest(MODULE)


def test_all_that_a_problem_offers_is_told():
    """What the package may ask of a Problem must decide its programs."""
    from jaxguide.problem import told as of_problems

    elsewhere = {"optimal_control", "parameter_paths", "check_statement"}  # the last: host alone
    known = {*of_problems._DATA, *of_problems._ALONG, *of_problems._AT_ENDS, *elsewhere}
    assert {name for name in dir(jg.Problem) if not name.startswith("_")} <= known
    fields = {field.name for field in dataclasses.fields(jg.Problem)}
    assert fields <= known


def test_the_package_is_in_the_key(monkeypatch):
    code = fingerprint.known_code()
    fingerprint.known_code.cache_clear()
    monkeypatch.setattr(fingerprint.importlib.metadata, "version", lambda name: "0")
    assert fingerprint.known_code() != code
    fingerprint.known_code.cache_clear()


SCRIPT = """
import json, jax, sys
jax.config.update("jax_enable_x64", True)
import jaxguide as jg, jax.numpy as jnp
class Spring(jg.Problem):
    state_names = ("x", "v")
    control_names = ("u",)
    initial_state = (0.0, 0.0)
    final_time = 2.0
    def dynamics(self, t, x, u):
        return jnp.stack([x[1], u[0] - STIFFNESS * x[0] ** 3])
    def running_cost(self, t, x, u):
        return 0.5 * u[0] ** 2
    def endpoint_constraints(self, x0, xf, t0, tf):
        return xf - jnp.array([1.0, 0.0])
compiled = []
def listen(event, duration, **kwargs):
    if event == "/jax/core/compile/jaxpr_to_mlir_module_duration":
        compiled.append(kwargs.get("fun_name", ""))
jax.monitoring.register_event_duration_secs_listener(listen)
e = jg.solve(Spring(), jg.Pseudospectral(segments=4, refinements=0))
lowered = [name for name in compiled if "point_" in name]
# LAPACK is looked up when a program that calls it is lowered, or else when it is loaded.
from jaxguide.host.executables import kept
values = kept(jnp.linalg.eigvalsh)(4 * jnp.eye(3))
lowered += [name for name in compiled if "eigvalsh" in name]
assert (values == 4).all()
print(json.dumps({"J": float(e.objective), "lowered": lowered, "name": type(e.problem).__name__}))
"""


def test_a_script_again_traces_nothing_twice(tmp_path):
    """And never takes the program of a problem that was changed."""
    given = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", "TF_CPP"))}
    given |= {cache.VARIABLE: str(tmp_path / "programs")}

    def run(stiffness):
        command = [sys.executable, "-c", SCRIPT.replace("STIFFNESS", stiffness)]
        done = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    first, again, other = run("1.0"), run("1.0"), run("3.0")
    assert first["lowered"] and not again["lowered"] and other["lowered"]
    assert again["J"] == first["J"]
    assert abs(other["J"] - first["J"]) > 0.1
