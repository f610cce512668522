# SPDX-License-Identifier: Apache-2.0

"""A user's own metrics: found by path or installed, measured by a run, checked before it."""

import json

import pytest

from cloudrc.results.metrics.measure import measure_all
from tests.results.metrics.conftest import straight_flight

OVERSHOOT = '''"""Largest distance by which the robot flies past the setpoint along x.

More text.
"""
import numpy as np
UNIT = "m"
def measure(flight):
    control = flight.control
    past = flight.true_position(control["stamp_ns"])[:, 0] - control["setpoint"][:, 0]
    return max(0.0, np.nanmax(past))
'''
FAILING = '"""A metric."""\nUNIT = "1"\ndef measure(flight):\n    '
BODIES = {
    "overshoot": OVERSHOOT,
    "raises": f"{FAILING}raise RuntimeError('no such\\ncolumn')",
    "huge": f"{FAILING}return -1e31",
    "exits": f"{FAILING}raise SystemExit(0)",
}
CHANGING = f"""{FAILING}flight.truth["position"] *= 1000.0
    flight.control["measured"] = flight.control["measured"][:0]
    flight.clearance[:] = 0.0
    flight.applied.clear()
    return flight.truth["position"].max()
"""
SHORT = ["steps", "--mode", "virtual", "--set", "mission.steps.count=1"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    for name, text in BODIES.items():
        (tmp_path / "mine" / f"{name}.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def report_of(run):
    return json.loads((run / "report.json").read_text())


def test_a_later_report_measures_a_file_only_if_named(folder, monkeypatch, call):
    run, names = folder / "run", ("exits", "huge", "overshoot", "raises")
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {})
    monkeypatch.setattr("cloudrc.results.report.write._replay", lambda assessment: "")
    asked = f"report.metrics=[{', '.join(f'mine/{name}.py' for name in names)}]"
    call("run", *SHORT, "--set", asked, "--out", run)
    first = report_of(run)
    overshoot = first["numbers"]["overshoot"]
    assert (overshoot["value"] >= 0.0, overshoot["unit"]) == (True, "m")
    assert first["notes"] == [
        "metric exits failed: exits.py:4: SystemExit: 0 (sys.exit() was called)",
        "metric huge failed: InvalidValueError: its value is -1e+31, not a finite number",
        "metric raises failed: raises.py:4: RuntimeError: no such column",
    ]
    assert "flies past the setpoint along x" in (run / "report.html").read_text()
    assert str(folder / "mine" / "overshoot.py") in (run / "config.yaml").read_text()

    monkeypatch.setattr("cloudrc.results.report.write._draw", lambda *given, **wanted: None)
    call("report", run)
    again = report_of(run)
    assert again["numbers"] == {k: v for k, v in first["numbers"].items() if k != "overshoot"}
    told = [note.split(":")[0] for note in again["notes"]]
    assert told == [f"metric {name} is not measured" for name in names]
    call("report", run, *(f"--metric=mine/{name}.py" for name in names))
    last = report_of(run)
    assert last == first
    assert "exits.py" in first["traceback"]


def test_the_summary_of_run_and_report_has_own_metrics_with_their_units(folder, monkeypatch, call):
    monkeypatch.setattr("cloudrc.results.report.write._draw", lambda *given, **wanted: None)
    flown = call("run", *SHORT, "--set", "report.metrics=mine/overshoot.py", "--out", "run").out
    again = call("report run --metric=mine/overshoot.py").out
    for said in (flown, again):
        (line,) = [each.split() for each in said.splitlines() if "overshoot" in each]
        assert (line[0], len(line), line[2] in ("m", "mm")) == ("overshoot", 3, True)
        assert float(line[1]) >= 0.0
    assert "overshoot is not measured" in call("report run").out


@pytest.mark.parametrize(
    ("names", "text", "reason"),
    [
        (["bad.py"], "def measure(flight): ...", "needs a text UNIT"),
        (["duration.py"], OVERSHOOT, "duration is a metric already; rename the file"),
        (["bad.py", "mine/../bad.py"], OVERSHOOT, "2 metrics have this name"),
    ],
)
def test_an_invalid_metric_is_refused_in_one_line(folder, refused, names, text, reason):
    (folder / names[0]).write_text(text)
    for line in (
        ["run", *SHORT, "--seeds", "2", "--set", f"report.metrics={json.dumps(names)}"],
        ["report", "mine", *(f"--metric={name}" for name in names)],
    ):
        assert reason in refused("", *line)
    assert not (folder / "runs").exists()


def test_a_metric_that_changes_its_arrays_changes_no_other_number(folder):
    (folder / "a_changing.py").write_text(CHANGING)  # its name comes before those of cloudrc
    (folder / "a_writing.py").write_text(
        f"{FAILING}flight.recording['/ground_truth']['position'][:] = 0.0"
    )
    wanted = measure_all(straight_flight()).numbers
    flight = straight_flight()
    numbers, notes, _ = measure_all(flight, ["./a_changing.py", "./a_writing.py"])
    assert numbers.pop("a_changing").value > 1000.0
    assert numbers == wanted
    assert notes == [
        "metric a_writing failed: a_writing.py:4: ValueError: assignment destination is read-only"
    ]
    assert flight.truth["position"].max() < 100.0  # also for verdict and figures
