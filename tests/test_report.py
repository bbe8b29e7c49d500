import io
import json

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from jaxguide import reproduce
from jaxguide.reproduce.report import Report, Row, jsonable
from jaxguide.types import UnknownName


def test_passes_within_the_larger_tolerance():
    within = lambda computed, **tolerance: Row("a", computed, 2.0, **tolerance).passed
    assert within(2.1, tolerance=0.2) and not within(2.1, tolerance=0.05)
    assert within(2.1, relative=0.06) and not within(2.1, relative=0.04)
    assert within(2.1, tolerance=1e-9, relative=0.06)
    assert not within(np.nan, tolerance=1.0)


def test_printed_value_is_never_judged():
    row = Row("a", 1.0, printed=5.0, tolerance=0.1)
    assert row.passed and not row.judged and row.deviation == -4.0


def test_report_passes_only_if_something_was_judged():
    report = Report("r")
    section = report.section("s")
    section.add("told", 1.0)
    assert not report.passed
    section.add("good", jnp.asarray(1.0), 1.0, tolerance=0.0)
    assert report.passed
    section.add("bad", 1.0, 1.1, tolerance=0.0)
    assert not report.passed


def test_json_has_plain_finite_numbers():
    report = Report("r", timings={"solve": 0.1}, extra={"K": jnp.array([1.0, jnp.inf])})
    report.section("s").add("a", np.nan, 1.0, tolerance=np.inf)
    read = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert read["passed"] is False and read["extra"]["K"] == [1.0, None]
    assert read["sections"][0]["rows"][0]["computed"] is None


def test_jsonable_leaves():
    tree = {"a": (np.float32(0.5), np.int64(2), np.bool_(True), True), 1: "x", "n": None}
    assert json.dumps(jsonable(tree)) == '{"a": [0.5, 2, true, true], "1": "x", "n": null}'


def test_printed_table():
    report = Report("title", figures=["a.png"], timings={"solve": 1.0})
    section = report.section("s", "Why.")
    section.add("case [1]", 1.5252777006, 1.525277700649, printed=1.525, tolerance=1e-8, unit="LU")
    section.add("off", 2.0, 1.0, tolerance=1e-3, note="doubtful")
    text = io.StringIO()
    report.print(Console(file=text))
    for expected in ("case [1] [LU]", "1.5252777", "OUT", "doubtful", "1 of 2 rows", "a.png"):
        assert expected in text.getvalue()


def test_unknown_reproduction_suggests_the_nearest():
    assert "earth-mars" in reproduce.names()
    with pytest.raises(UnknownName, match="earth-mars"):
        reproduce.get("earth-mar")
