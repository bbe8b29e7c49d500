"""Sweeps read and written: dispersions from files, exports, the report, and one case again."""

# Tests hand over what a type checker would refuse, on purpose.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false

import csv
import dataclasses
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from test_montecarlo import Cliff
from test_sweep_store import flown, mission

import jaxguide as jg
from jaxguide import cli, problems
from jaxguide.cli import sweeping
from jaxguide.export import export
from jaxguide.host import flags
from jaxguide.montecarlo.rollouts import case_key, draw
from jaxguide.report import html, write
from jaxguide.sweeping.written import as_written

pytest.importorskip("zarr")
__all__ = ["mission"]  # a fixture


@pytest.fixture(scope="module")
def store(mission, tmp_path_factory):
    """A sweep with failures, in chunks, with some flights in full."""
    path = tmp_path_factory.mktemp("stores") / "a.zarr"
    cliff = dataclasses.replace(mission, plant=Cliff())
    return path, flown(cliff, store=path, chunk=16, histories=12, failures=5).load()


# Dispersions from files ------------------------------------------------------------------------

TOML = """
[initial_state]
kind = "normal"
std = [0.02, 0.01]

[plant.k]
kind = "relative"
distribution = { kind = "truncated-normal", std = 0.05, lo = -0.1, hi = 0.1 }
"""
YAML = """
"initial_state, plant.k":
  kind: multivariate-normal
  cov: [[4.0e-4, 0.0, 1.0e-4], [0.0, 1.0e-4, 0.0], [1.0e-4, 0.0, 4.0e-4]]
"""


def test_dispersions_from_files(mission, tmp_path):
    (tmp_path / "d.toml").write_text(TOML)
    (tmp_path / "d.yaml").write_text(YAML)
    cut = jg.Relative(jg.TruncatedNormal(0.05, -0.1, 0.1))
    by_hand = {"initial_state": jg.Normal(np.array([0.02, 0.01])), "plant.k": cut}
    read = jg.dispersions_from(tmp_path / "d.toml")
    key = case_key(7, 3)
    for a, b in zip(draw(mission, read, key).values(), draw(mission, by_hand, key).values()):
        np.testing.assert_array_equal(a, b)
    pytest.importorskip("yaml")
    (paths,) = jg.dispersions_from(str(tmp_path / "d.yaml"))
    assert paths == ("initial_state", "plant.k")
    for source in (by_hand, jg.dispersions_from(tmp_path / "d.yaml")):
        told = as_written(source)
        assert as_written(jg.dispersions_from(json.loads(json.dumps(told)))) == told

    class Own(jg.Normal):
        pass

    assert as_written({"plant.k": Own(1.0)}) is None


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("d.toml", "[plant.k]\nkind = 'norml'\nstd = 1", "plant.k: kind is 'norml'; did you"),
        ("d.toml", "[plant.k]\nkind = 'normal'\nsdt = 1.0", "no 'sdt'; did you mean 'std'"),
        ("d.toml", "[plant.k]\nkind = 'normal'\nstd = -1.0", "plant.k: Normal: std is -1.0; give"),
        ("d.toml", "[plant.k]\nkind = 'normal'\nstd = 'big'", "std is 'big'; give a number"),
        ("d.toml", "[plant.k]\nkind = 'uniform'\nlo = 1", "plant.k: uniform needs hi; give it"),
        ("d.toml", "[plant]\nk = 0.1", "plant.k is 0.1; give a table with a kind"),
        ("d.toml", "[plant.k", "Expected ']'"),
        ("d.yaml", "!!python/object/apply:os.system ['true']", "is no plain YAML"),
        ("d.ini", "", "ends in '.ini'; give a .toml, .yaml"),
    ],
)  # fmt: skip
def test_files_that_are_wrong(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=f"(?s){re.escape(str(tmp_path / name))}: .*{words}"):
        jg.dispersions_from(tmp_path / name)


# Exports ---------------------------------------------------------------------------------------


def test_csv_reads_back_to_the_same_bits(store, tmp_path):
    path, data = store
    with export(path, tmp_path / "a.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 100
    column = lambda name: np.array([float(row[name]) for row in rows])
    np.testing.assert_array_equal(column("final_state[v]"), data.final_state.values[:, 1])
    np.testing.assert_array_equal(column("draw:plant.k"), data["draw:plant.k"].values)
    failed = [row["result"] == "diverged" for row in rows]
    np.testing.assert_array_equal(failed, data.result.values != 0)
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_json_has_everything(store, tmp_path):
    path, data = store
    told = json.loads(export(path, tmp_path / "a.json").read_text())
    np.testing.assert_array_equal(told["cases"]["miss"], data.miss.values)
    assert told["summary"]["failures"] == data.attrs["failures"]
    assert told["sweep"]["seed"] == 7 and "plant" in told["about"]


def test_parquet(store, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    path, data = store
    table = parquet.read_table(export(path, tmp_path / "a.parquet"))
    np.testing.assert_array_equal(table["final_state[x]"], data.final_state.values[:, 0])
    assert table["result"].to_pylist().count("diverged") == data.attrs["failures"]["diverged"]
    assert json.loads(table.schema.metadata[b"sweep"])["seed"] == 7


def test_netcdf(store, tmp_path):
    pytest.importorskip("h5netcdf")
    path, data = store
    with xr.open_dataset(export(path, tmp_path / "a.nc"), engine="h5netcdf") as read:
        for name in ("final_state", "result", "draw:plant.k", "history_x"):
            np.testing.assert_array_equal(read[name].values, data[name].values)
        assert list(read.state.values) == ["x", "v"]
        assert json.loads(read.attrs["failures"]) == data.attrs["failures"]


def test_exports_that_cannot_be(store, tmp_path):
    with pytest.raises(ValueError, match="ends in '.xls'; choose one of .csv, .json"):
        export(store[0], tmp_path / "a.xls")
    with pytest.raises(ValueError, match="holds no sweep"):
        export(tmp_path, tmp_path / "a.csv")


# The report ------------------------------------------------------------------------------------


class Page(HTMLParser):
    """What a page would fetch, its headings, and its open tags."""

    VOID = {"meta", "br", "link", "img", "path", "use", "image", "rect"}

    def __init__(self, text):
        super().__init__()
        self.fetched, self.headings, self.open, self.scripts = [], [], [], 0
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "srcset", "data", "action"):
                self.fetched.append(value)
        self.scripts += tag == "script"
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("h1", "h2"):
            self.headings.append(data)


def self_contained(text):
    page = Page(text)
    assert page.open == [] and page.scripts == 0
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.fetched)
    # Beside names of XML's own, no address at all; nothing is imported by the style.
    addresses = set(re.findall(r"[a-z]+://[^\s\"'<]+", text))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert "@import" not in text and not re.findall(r"url\((?!#)", text)
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids)) and set(re.findall(r'"#([^"]+)"', text)) <= set(ids)
    return page


def test_report_of_everything(store):
    path, data = store
    text = html(path)
    headings = self_contained(text).headings
    assert headings == [
        "Sweep of Cliff, 100 flights", "What was flown", "Failures", "Statistics of the end",
        "How the ends are spread", "Dispersion of the final state", "What matters",
        "Draws against miss", "Envelopes", "Worst flights",
    ]  # fmt: skip
    assert text.count("<svg") == 5
    low, high = data.attrs["success_rate_bounds"]
    assert f"{100 * low:.4f} to {100 * high:.4f} %" in text
    assert "left finite numbers" in text  # what the failure means
    assert f"jg.rerun(mission, dispersions, 7, {data.attrs['worst'][0]['case']})" in text
    assert html(path) == text  # the same file from the same store


def test_report_of_a_summary_says_what_it_cannot_show(mission, tmp_path):
    flown(mission, store=tmp_path / "s.zarr", keep="summary", label="<mine>")
    text = html(tmp_path / "s.zarr")
    self_contained(text)
    assert "keeps a summary, no single flights" in text and "--histories" in text
    assert "&lt;mine&gt;" in text and "<mine>" not in text
    assert text.count("<svg") == 3  # spread, ellipses, sensitivities


def test_report_of_an_unfinished_sweep(mission, tmp_path):
    class Halt:
        init = close = lambda self, *a: None

        def step(self, state, progress):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        flown(mission, store=tmp_path / "a", chunk=16, progress=Halt())
    with pytest.raises(ValueError, match="was not flown to its end; go on .* --resume"):
        write(tmp_path / "a")


@pytest.mark.slow
def test_report_in_a_browser(store, tmp_path):
    """Headless Chromium, without network: it draws every figure, in a light and a dark scheme."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("no chromium here; apt-get install chromium")
    image = pytest.importorskip("PIL.Image")
    page = write(store[0], tmp_path / "report.html")
    quiet = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    offline = ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}"]
    means = []
    for scheme in (1, 0):  # light, dark
        shot = tmp_path / f"{scheme}.png"
        options = [f"--blink-settings=preferredColorScheme={scheme}", "--window-size=1000,4600"]
        command = [browser, *quiet, *offline, *options, f"--screenshot={shot}", page.as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        pixels = np.asarray(image.open(shot).convert("L"), float)
        assert pixels.shape == (4600, 1000)
        means.append(pixels.mean())
        # Ink everywhere down the page, but for the end: no figure is missing or empty.
        rows = np.abs(pixels - np.median(pixels)).max(axis=1) > 40
        gaps = np.diff(np.flatnonzero(rows))
        assert gaps.max() < 160 and np.flatnonzero(rows)[-1] > 3300
    assert means[0] > 200 and means[1] < 60


# The command line ------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_store_is_read_by_the_command_line(mission, tmp_path, monkeypatch, capfd):
    """rerun by the store's own dispersions; refused where the mission has changed since."""
    monkeypatch.setattr(cli, "configure", lambda kept: None)
    (tmp_path / "d.toml").write_text(TOML)
    spread = jg.dispersions_from(tmp_path / "d.toml")
    path = str(tmp_path / "a.zarr")
    jg.sweep(mission, spread, 40, 7, tile=8, store=path, label="mine", sampling="sobol")
    fakes = {
        "mission": lambda name: mission,
        "dispersions": lambda name: {},
        "get": lambda name: mission.plant,
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(problems, name, fake)
    run = lambda *line: (cli.run([*line, "--json"]), json.loads(capfd.readouterr().out))
    code, told = run("sweep", "rerun", path, "33")
    assert code == 0 and told["same"] and told["note"] == ""
    code, told = run("report", path)
    assert code == 0 and told["report"] == str(tmp_path / "a.html")
    code, told = run("export", path, str(tmp_path / "b.csv"))
    assert code == 0 and len((tmp_path / "b.csv").read_text().splitlines()) == 41
    code, told = run("compare", path, path, "--quantity", "x")
    assert code == 0 and told["difference"] == 0.0 and told["lower"] == 0.5
    heavier = dataclasses.replace(mission, plant=dataclasses.replace(mission.plant, k=1.5))
    monkeypatch.setattr(problems, "mission", lambda name: heavier)
    code, told = run("sweep", "rerun", path, "33")
    assert code == 1 and "flown by another mission: mission: plant (" in told["error"]


def test_options_of_xla(mission, tmp_path, monkeypatch):
    """Asked for once, the user's own left alone; a store says them, since they decide roundings."""
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    assert flags.deciding() == ""  # as many devices as one likes: the same bits
    flags.set_for_flights()
    flags.set_for_flights()
    assert flags.deciding() == flags.FLIGHTS
    flags.take("--xla_other=1")
    assert os.environ["XLA_FLAGS"] == "--xla_other=1 --xla_force_host_platform_device_count=2"
    path = tmp_path / "a"
    flown(mission, store=path, label="mine")
    sweeping.options_of_xla(sweeping.sweep, {})
    with pytest.raises(ValueError, match="made by another sweep: xla"):
        flown(mission, store=path, label="mine", resume=True)
    sweeping.options_of_xla(sweeping.rerun, {"store": path})
    assert flags.deciding() == "--xla_other=1"
    flown(mission, store=path, label="mine", resume=True)
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_extra_options=mine")
    flags.set_for_flights()
    assert flags.deciding() == "--xla_backend_extra_options=mine"
