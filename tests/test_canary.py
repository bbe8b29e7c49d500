"""The JAX fault that makes this package refuse 0.10.2: see `jaxguide.doctor`."""

import jax
import numpy as np
import pytest

from jaxguide import doctor


def test_this_jax_is_sound():
    assert doctor.canary() == 0


def test_canary_sees_a_wrong_row(monkeypatch):
    """Stands in for a faulty release: `jit` spoils the rows past 16,384, as 0.10.2 does."""
    jit = jax.jit

    def faulty(f):
        def wrong(x):
            y = np.asarray(jit(f)(x)).copy()
            y[16_384:] = 0
            return y

        return wrong

    monkeypatch.setattr(jax, "jit", faulty)
    spoilt = sum(max(rows - 16_384, 0) for rows in doctor.CANARY_ROWS)
    assert doctor.canary() == 2 * len(doctor.CANARY_COLUMNS) * spoilt  # both dtypes


def test_report_names_every_check_with_a_remedy(monkeypatch):
    monkeypatch.setattr(doctor, "canary", lambda: 7)
    monkeypatch.setattr(doctor, "FAULTY_JAX", (jax.__version__,))
    checks = doctor.check_installation()
    assert {*doctor.PACKAGES, "python", "devices", "x64", "compilation cache"} <= set(checks)
    for name in ("canary", "faulty jax"):
        assert not checks[name]["ok"]
        assert checks[name]["remedy"]
    assert checks["x64"]["ok"] and checks["x64"]["remedy"] == ""


@pytest.mark.parametrize("version", ["0.10.2", "0.9.2"])
def test_refused_versions(monkeypatch, version):
    monkeypatch.setattr(doctor, "canary", lambda: 0)
    monkeypatch.setattr(doctor.importlib.metadata, "version", lambda name: version)
    monkeypatch.setattr(doctor, "_requirements", lambda: {"python": "", "jax": ">=0.10.0,!=0.10.2"})
    assert not doctor.check_installation()["jax"]["ok"]
