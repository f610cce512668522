# SPDX-License-Identifier: Apache-2.0

"""The Python API: one call flies and returns verdict, numbers and columns."""

import importlib
import json
import os
import pkgutil
import runpy
from pathlib import Path

import numpy as np
import pytest

import cloudrc
from cloudrc.base.errors import BadInputError
from tests.support.commands import python
from tests.support.pages import blocks

ROOT = Path(__file__).resolve().parents[2]
SHORT = {"mission.steps.count": 1, "link.profile": "paper-p1"}


@pytest.fixture(scope="module")
def result():
    return cloudrc.fly("steps", SHORT, seed=3)


def test_a_flight_equals_that_of_the_command(result, tmp_path, call, no_page):
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


def test_the_tables_of_a_flight_can_be_changed(result):
    tables = (result.applied, result.flight.truth, result.flight.during("/odometry"))
    assert all(column.flags.writeable for table in tables for column in table.values())
    assert not np.shares_memory(
        result.flight.truth["position"], result["/ground_truth"]["position"]
    )


def test_a_failed_mission_is_a_result():
    lost = {"link.downlink.loss": 1.0, "criteria.time_limit_s": 6}
    with pytest.warns(UserWarning, match="loses 100 %"):
        result = cloudrc.fly("steps", {**SHORT, **lost}, seed=1)
    assert result.verdict == "failure"
    assert result.failures[0].text in repr(result)


def test_every_function_can_be_called_after_every_module_is_imported():
    """A subpackage with the name of a function would take its place."""
    for module in pkgutil.walk_packages(cloudrc.__path__, "cloudrc."):
        # The bridge to ROS 2 needs a ROS.
        if not module.name.endswith("__main__") and ".bridges." not in module.name:
            importlib.import_module(module.name)
    names = [name for name in cloudrc.__all__ if not name.startswith("_")]
    assert all(callable(getattr(cloudrc, name)) for name in names)
    assert callable(cloudrc.sweep)


def test_a_flight_with_a_folder_equals_one_without(result, tmp_path, no_page):
    (tmp_path / "again.yaml").write_text(result.config)
    kept = cloudrc.fly(str(tmp_path / "again.yaml"), out=tmp_path / "run")
    assert (kept.numbers, kept.records_sha256) == (result.numbers, result.records_sha256)
    assert (tmp_path / "run/report.json").is_file()
    assert len(kept["/odometry"]) == len(result["/odometry"])
    with pytest.raises(BadInputError, match="already exists"):
        cloudrc.fly("steps", SHORT, out=tmp_path / "run")


GRID = {"experiment": "steps", "set": SHORT, "grid": {"link.both.delay_ms": np.array([5, 40])}}


def test_a_sweep_is_a_table_of_arrays_that_goes_on(result, tmp_path, capfd):
    folder = tmp_path / "sweep"
    table = cloudrc.sweep({**GRID, "seeds": [3]}, out=folder)
    assert table["link.both.delay_ms"].tolist() == [5, 40]
    assert table.units["prediction_error_rms"] == "m"
    again = cloudrc.sweep({**GRID, "seeds": [3, 4]}, out=folder)
    assert again["seed"].tolist() == [3, 4, 3, 4]
    assert again["prediction_error_rms"][0] == table["prediction_error_rms"][0]
    assert len((folder / "rows.jsonl").read_text().splitlines()) == 4
    assert capfd.readouterr() == ("", "")
    with pytest.raises(KeyError, match="columns: key, link"):
        table["prediction_error"]


def test_none_in_an_axis_of_numbers_is_nan_and_texts_stay_texts():
    grid = {"criteria.settle_m": [None, 0.5], "cloud.predictor": ["last_sample"]}
    table = cloudrc.sweep({"experiment": "steps", "set": SHORT, "grid": grid})
    assert np.array_equal(table["criteria.settle_m"], [np.nan, 0.5], equal_nan=True)
    assert table["criteria.settle_m"].dtype == np.float64
    assert table["cloud.predictor"].tolist() == ["last_sample"] * 2


def test_a_comparison_has_a_p_value_and_all_of_the_commands_document():
    found = cloudrc.compare(
        "cloud.predictor=last_sample",
        {"cloud.predictor": "constant_velocity"},
        settings={**SHORT, "mission.steps.period_s": 2, "criteria.settle_m": None},
        seeds=6,
    )
    assert (found.name, found.p < 0.05) == ("prediction_error_rms", True)
    assert found.document["pairs"] == 6
    assert found.difference < 0


def test_the_cost_of_control_is_relative_to_the_same_flight_without_a_network():
    far = {"link.both.delay_ms": 200, "link.both.loss": 0.1, "guard.command_age_max_ms": 900}
    near = dict.fromkeys(far, 0.0) | {"guard.command_age_max_ms": 900}
    common = {**SHORT, "link.profile": "ideal", "criteria.settle_m": None}
    found = cloudrc.compare(near, far, settings=common, seeds=1, cost=True)
    assert found.name == "J/J0"
    (each,) = found.document["flights"]
    assert each["a"]["numbers"]["J/J0"] == 1.0 < each["b"]["numbers"]["J/J0"]
    assert each["b"]["numbers"]["bytes_sent_downlink"] > 0


def test_a_margin_is_that_of_the_command(capfd):
    found = cloudrc.margin("link.uplink.delay_ms", settings=SHORT, seeds=1, largest=10)
    assert (found["settles_up_to"], found["stable_up_to"]) == (10.0, 10.0)
    assert capfd.readouterr() == ("", "")


def test_a_script_flies_in_several_processes(tmp_path):
    """It needs no `if __name__ == "__main__"`: a worker does not run the script again."""
    grid = {"experiment": "steps", "set": SHORT, "seeds": 2}
    (tmp_path / "own.py").write_text(f"import cloudrc\nprint(len(cloudrc.sweep({grid}, jobs=2)))")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = python("own.py", cwd=tmp_path, env=environment)
    assert done.stdout == "2\n", done.stderr


def test_importing_cloudrc_imports_only_the_version():
    heavy = "('cloudrc.', 'numpy')"
    code = f"import sys, cloudrc; print([m for m in sys.modules if m.startswith({heavy})])"
    assert python("-c", code, cwd=ROOT).stdout == "['cloudrc.version']\n"


def test_the_example_of_the_page_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "page.py").write_text(blocks("python", "python")[0])
    runpy.run_path("page.py")
    assert capsys.readouterr().out.startswith("success []\n")


@pytest.mark.process
@pytest.mark.full
def test_the_examples_with_many_flights_run(tmp_path):
    (tmp_path / "page.py").write_text("import cloudrc\n" + blocks("python", "python")[1])
    done = python("page.py", cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert (done.returncode, len(done.stdout.splitlines())) == (0, 5), done.stderr


@pytest.mark.process
def test_a_link_is_verified(capfd):
    settings = {"link.both.delay_ms": 100, "link.both.jitter_ms": 0}
    found = cloudrc.verify("paper-p1", settings, seconds=2)
    assert found["link"] == "paper-p1"
    (mean,) = (r for r in found["directions"]["uplink"]["rows"] if r["name"] == "mean")
    assert mean["asked"] == pytest.approx(0.1)
    assert capfd.readouterr() == ("", "")
