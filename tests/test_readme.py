"""The README's example runs as printed, in a process without the test suite's settings."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run(code, folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def blocks(kind):
    text = (ROOT / "README.md").read_text()
    return re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)


@pytest.mark.slow
def test_example(tmp_path):
    (code,) = blocks("python")
    printed = run(code, tmp_path)
    assert "transversality" in printed and "final_state" in printed  # certificate and flights


@pytest.mark.slow
def test_tuning_goes_on_from_the_example(tmp_path):
    (begun,), (more,) = blocks("python"), blocks("py")
    assert "Tuned: loss" in run(begun + more, tmp_path)


def test_pictures_and_links_exist():
    text = (ROOT / "README.md").read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if "://" not in target:
            assert (ROOT / target).exists(), target
