"""The Python API: one call flies and returns verdict, numbers and columns."""

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cloudrc
from cloudrc.errors import BadInputError

ROOT = Path(__file__).resolve().parents[1]
SHORT = {"mission.steps.count": 1, "link.profile": "paper-p1"}


@pytest.fixture(scope="module")
def result():
    return cloudrc.fly("steps", SHORT, seed=3)


def test_a_flight_equals_that_of_the_command(result, tmp_path, call, monkeypatch):
    monkeypatch.setattr("cloudrc.report.write._write_page", lambda *given: None)
    sets = [f"--set={key}={value}" for key, value in SHORT.items()]
    out = call("run steps --mode=virtual --seed=3 -o=json", *sets, "--out", tmp_path / "run").out
    report = json.loads(out)
    assert result.records_sha256 == report["records_sha256"]
    assert result.verdict == report["verdict"]
    measured = {name: (value, result.units[name]) for name, value in result.numbers.items()}
    assert measured == {n: (e["value"], e["unit"]) for n, e in report["numbers"].items()}
    assert result["/odometry"]["position"].shape == (len(result["/odometry"]), 3)
    assert len(result.steps) == 1
    assert result.applied["horizon"].min() >= 0.0


def test_the_configuration_repeats_the_flight(result, tmp_path):
    path = tmp_path / "again.yaml"
    path.write_text(result.config)
    assert cloudrc.fly(str(path)).records_sha256 == result.records_sha256


def test_values_of_numpy_and_mappings_are_settings():
    pid = {"name": "pid", "gain_p": np.array([0.5, 0.5, 0.5])}
    settings = {**SHORT, "seed": np.int64(4), "cloud.controller": pid}
    assert "gain_p: [0.5, 0.5, 0.5]" in cloudrc.fly("steps", settings).config


def test_a_failed_mission_is_a_result():
    with pytest.warns(UserWarning, match="loses 100 %"):
        result = cloudrc.fly("steps", {**SHORT, "link.downlink.loss": 1.0}, seed=1)
    assert result.verdict == "failure"
    assert result.failures[0].text in repr(result)


@pytest.mark.parametrize(
    "settings", [{"cloud.predictr": 1}, {"seed": float("nan")}, {"report.metrics": ["metrics x"]}]
)
def test_a_wrong_setting_is_refused_before_the_flight(settings):
    with pytest.raises(BadInputError, match=next(iter(settings)).rpartition(".")[2][:6]):
        cloudrc.fly("steps", settings)


def test_importing_cloudrc_imports_nothing_else():
    heavy = "('cloudrc.', 'numpy')"
    code = f"import sys, cloudrc; print([m for m in sys.modules if m.startswith({heavy})])"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout == "[]\n"


def test_the_example_of_the_page_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "python.md").read_text()
    (tmp_path / "page.py").write_text(re.search("```python\n(.*?)```", page, re.DOTALL)[1])
    runpy.run_path("page.py")
    assert capsys.readouterr().out.startswith("success []\n")


@pytest.mark.full
@pytest.mark.parametrize("path", [*ROOT.glob("docs/notebooks/*.ipynb")], ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path):
    cells = json.loads(path.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
