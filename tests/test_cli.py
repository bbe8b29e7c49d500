"""The command line on stand-ins for the library: what it prints where, and how it ends."""

import io
import json
import os
import subprocess
import sys
import time
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import jaxguide
from jaxguide import cli, doctor, plotting, problems, reproduce
from jaxguide.host.progress import spoken
from jaxguide.reproduce.report import Report
from jaxguide.types import RESULTS, UnknownName

N, M, T = 2, 1, 5


def problem(name):
    if name != "earth-mars":
        raise UnknownName("problem", name, ("earth-mars",))
    return types.SimpleNamespace(state_names=("r", "v"), control_names=("epsilon",))


def extremal(ok=True):
    certificate = types.SimpleNamespace(
        passed=jnp.array([ok]), rows=lambda: [{"check": "stationarity", "passed": ok}]
    )
    return types.SimpleNamespace(
        t=jnp.linspace(0.0, 1.0, T),
        x=jnp.zeros((T, N)),
        u=jnp.zeros((T, M)),
        costate=jnp.full((T, N), jnp.nan),
        final_time=jnp.asarray(1.0),
        objective=jnp.asarray(-1.5),
        result=RESULTS.successful,
        certificate=certificate,
    )


def gain_schedule(extremal, times, method="segmented", nodes=None):
    k = times.shape[0]
    K = jnp.ones((k, M, N))
    return types.SimpleNamespace(times=times, K=K, error=jnp.zeros(k), resolved=jnp.ones(k, bool))


def flight(mission):
    final_state = jnp.array([1.0, 2.0])
    result = RESULTS.diverged if mission == "bad" else RESULTS.successful
    states, t = jnp.zeros((T, N)), jnp.linspace(0.0, 1.0, T)
    return types.SimpleNamespace(
        t=t, x=states, u=states[:, :M], final_state=final_state, final_time=t[-1], result=result
    )


ATTRS = {"rollouts_per_s": 1e5, "compile_s": 0.5, "percentiles": {"99": 1.0}, "failures": 0}


def sweep(mission, dispersions, cases, seed, *, store, scheduler, dtype, progress, **resume):
    print("a library that prints")
    state = progress.init()
    progress.close(progress.step(state, 0.5))
    return xr.Dataset(attrs=ATTRS)


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch):
    monkeypatch.setattr(cli, "configure", lambda kept: None)  # the suite has settings of its own
    monkeypatch.setattr(doctor, "canary", lambda: 0)
    fakes = {
        jaxguide: {
            "solve": lambda problem, watch=None: extremal(),
            "gain_schedule": gain_schedule,
            "simulate": flight,
            "sweep": sweep,
        },
        problems: {
            "names": lambda: ("earth-mars",),
            "describe": lambda name: "a transfer",
            "get": problem,
            "mission": lambda name: "good",
            "dispersions": lambda name: {},
        },
        plotting: {
            f"plot_{k}": lambda *a: Figure() for k in ("extremal", "gains", "flight", "sweep")
        },
    }
    for module, values in fakes.items():
        for name, value in values.items():
            monkeypatch.setattr(module, name, value, raising=False)


def reproduction(monkeypatch, computed):
    def run(out, progress):
        report = Report("r")
        report.section("s").add("a", computed, 1.0, tolerance=1e-3)
        return report

    fake = types.SimpleNamespace(run=run)
    monkeypatch.setattr(reproduce, "get", lambda name: fake)


COMMANDS = {
    "problems": {"problems"},
    "solve earth-mars": {"objective", "final_time", "t", "x", "u", "costate", "certificate"},
    "gains earth-mars --count 3 --nodes 65 --method square": {"times", "K", "error", "resolved"},
    "fly earth-mars": {"t", "x", "u", "final_state", "final_time", "result"},
    "sweep earth-mars --cases 9 --seed 1 --dtype float32": {*ATTRS, "cases", "seed", "dtype"},
    "doctor": {"checks"},
}


@pytest.mark.parametrize("line", COMMANDS)
def test_json_is_one_object_on_stdout(line, capfd):
    cli.run([*line.split(), "--json"])
    out = capfd.readouterr().out
    assert out.count("\n") == 1
    assert COMMANDS[line] <= set(json.loads(out))


@pytest.mark.parametrize("line", [line for line in COMMANDS if line != "doctor"])
def test_tables_for_people(line, capfd):
    assert cli.run(line.split()) == 0
    out, err = capfd.readouterr()
    assert len(out) > 10 and "{" not in out.splitlines()[0] and err == ""


def test_values_in_json(capfd):
    assert cli.run(["solve", "earth-mars", "--json"]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["objective"] == -1.5 and np.shape(data["x"]) == (T, N)
    assert data["costate"] == [[None] * N] * T  # NaN is no JSON
    assert data["result"] == {"ok": True, "message": ""}


@pytest.mark.parametrize("command", ["solve", "gains", "fly", "sweep"])
def test_figures(command, tmp_path, capfd):
    more = ["--cases", "9", "--seed", "1"] if command == "sweep" else []
    out = tmp_path / "a" / "b"
    assert cli.run([command, "earth-mars", *more, "--out", str(out), "--json"]) == 0
    (figure,) = json.loads(capfd.readouterr().out)["figures"]
    assert [str(p) for p in out.iterdir()] == [figure]


@pytest.mark.parametrize("better", [True, False])
def test_tune(monkeypatch, tmp_path, capfd, better):
    """Relaxed, rounded, confirmed: both runs told, saved and drawn."""
    from jaxguide.tuning import Confirmed, Ready, load_history

    rows, places = {"gain evaluations": (166.0, 62.0)}, lambda own: {"places": own["a"]}
    ready = Ready(
        name="bowl", about="a bowl", objective=lambda own, keys: jnp.sum((own["a"] - 0.5) ** 2),
        design={"a": jnp.array([0.1, 0.9])}, build=lambda own: own, optimizer=None, steps=4,
        cases=2,
        confirm=lambda run, cases, seed: Confirmed(rows, {62: cases + seed}, ("a note",), better),
        places=places,
    )  # fmt: skip
    whole = ready._replace(rounded=lambda run: ready)
    monkeypatch.setattr(problems, "designs", lambda: ("bowl",))
    monkeypatch.setattr(problems, "design", lambda name, steps=4: whole._replace(steps=steps))
    monkeypatch.setattr(plotting, "plot_tuning", lambda *a: Figure())
    line = ["tune", "bowl", "--steps", "3", "--seed", "1", "--fresh", "9", "--out", str(tmp_path)]
    assert cli.run([*line, "--json"]) == 1 - better
    data = json.loads(capfd.readouterr().out)
    assert [run["steps"] for run in data["runs"]] == [3, 3] and data["beside"] == {"62": 11}
    assert len(load_history(tmp_path)["loss"]) == len(load_history(tmp_path / "rounded")["loss"])
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["bowl-rounded.png", "bowl-tuning.png"]
    cli.run(line)
    assert "166" in capfd.readouterr().out
    assert cli.run(["tune", "bowl", "--fresh", "0"]) == 1
    assert "--fresh must be at least 1, got 0" in capfd.readouterr().err


@pytest.mark.parametrize("computed", [1.0, 1.1])
def test_reproduction_out_of_tolerance_exits_with_1(monkeypatch, capfd, computed):
    reproduction(monkeypatch, computed)
    for options in ([], ["--json"]):
        assert cli.run(["reproduce", "earth-mars", *options]) == (computed != 1.0)
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["passed"] == (computed == 1.0)


def test_failed_certificate_flight_and_check_exit_with_1(monkeypatch, capfd):
    monkeypatch.setattr(jaxguide, "solve", lambda problem, watch=None: extremal(ok=False))
    assert cli.run(["solve", "earth-mars"]) == 1
    monkeypatch.setattr(problems, "mission", lambda name: "bad")
    assert cli.run(["fly", "earth-mars"]) == 1
    assert "diverged" in capfd.readouterr().out
    monkeypatch.setattr(doctor, "canary", lambda: 3)
    assert cli.run(["doctor"]) == 1
    assert "3 wrong rows" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("reproduce earth-mar", "earth-mars"),
        ("solve earthmars", "earth-mars"),
        ("gains mars", "earth-mars"),
        ("fly earth-mrs", "earth-mars"),
        ("solv earth-mars", "solve"),
        ("sweep earth-mars --case 3 --seed 1", "--cases"),
        ("sweep earth-mars --cases 3 --seed 1 --dtype floa32", "float32"),
        ("sweep earth-mars --cases 0 --seed 1", "--cases"),
        ("sweep earth-mars --cases 3 --seed 1 --resume", "--store"),
    ],
)
def test_wrong_words_end_in_one_line_with_the_right_ones(line, hint, capfd):
    assert cli.run(line.split()) != 0
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1 and hint in err


def test_library_error_is_its_message(monkeypatch, capfd):
    def unsolved(problem, watch=None):
        raise RuntimeError("the end is out of reach")

    monkeypatch.setattr(jaxguide, "solve", unsolved)
    assert cli.run(["solve", "earth-mars", "--json"]) == 1
    out, err = capfd.readouterr()
    assert err == "jaxguide: the end is out of reach\n"
    assert json.loads(out) == {"error": "the end is out of reach"}
    with pytest.raises(RuntimeError):
        cli.run(["solve", "earth-mars", "--debug"])


def python(code, **environment):
    ours = ("JAX_COMPILATION_CACHE_DIR", "EQX_ON_ERROR")
    inherited = {name: value for name, value in os.environ.items() if name not in ours}
    root = str(Path(__file__).parent.parent)
    environment = {**inherited, "PYTHONPATH": root, **environment}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)


def test_help_imports_no_jax():
    code = "import sys; from jaxguide import cli; cli.run(['--help']); print('jax' in sys.modules)"
    out = python(code).stdout.splitlines()
    assert out[-1] == "False"
    assert any("reproduce" in line for line in out)


def test_the_old_path_of_the_flags_imports_no_jax():
    code = (
        "import sys, jaxguide.montecarlo.flags as old; from jaxguide.host import flags; "
        "from jaxguide.montecarlo.flags import set_for_flights; "
        "from jaxguide.montecarlo import flags as again; "
        "print(old is flags is again, set_for_flights is flags.set_for_flights, "
        "'jax' in sys.modules)"
    )
    assert python(code).stdout.split() == ["True", "True", "False"]


@pytest.mark.parametrize("given", [False, True])
def test_configure(tmp_path, given):
    """float64 and a cache: the user's own if named, else in the user's cache folder."""
    cache = tmp_path / ("mine" if given else "jaxguide")
    environment = {"XDG_CACHE_HOME": str(tmp_path)}
    if given:
        environment["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    code = (
        "from jaxguide import cli; cli.configure(); import jax, equinox._config as c; "
        "print(jax.numpy.ones(3).sum().dtype, c.EQX_ON_ERROR)"
    )
    assert python(code, **environment).stdout.split() == ["float64", "nan"]
    assert len(list(cache.iterdir())) > 0


def test_progress_meters_fit_diffrax():
    import diffrax

    from jaxguide.host.progress import NoProgress, Progress, RichProgress

    bar = RichProgress("x", delay=0.0)
    assert all(isinstance(m, Progress) for m in (NoProgress(), bar, diffrax.NoProgressMeter()))
    state = bar.step(bar.init(), jax.numpy.asarray(0.5))
    assert state[0].tasks[0].percentage == 50.0
    bar.close(state)
    assert NoProgress().step(NoProgress().init(), 0.5) is None


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stderr", "wanted"), [(Terminal(), True), (Terminal(), False), (io.StringIO(), True)]
)
def test_long_work_says_what_it_is_at(monkeypatch, stderr, wanted):
    """On a terminal alone, and from a while on; it ends with a shown cursor, on failure too."""
    monkeypatch.setattr(sys, "stderr", stderr)
    with pytest.raises(ZeroDivisionError), spoken("Kink", wanted, delay=0.0) as say:
        time.sleep(0.3)  # the line begins in a thread of its own
        say("breaks moved")
        time.sleep(0.3)
        raise ZeroDivisionError
    shown = stderr.getvalue()
    if wanted and stderr.isatty():
        assert "Kink: breaks moved" in shown
        assert "\x1b[?25h" in shown.rsplit("breaks moved", 1)[1]
    else:
        assert shown == ""
