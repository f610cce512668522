# SPDX-License-Identifier: Apache-2.0

"""`cloudrc run` and `cloudrc report`: refused input, output, and the folder of a run."""

import json
import os
from unittest.mock import Mock

import pytest

from cloudrc.base import requirements
from cloudrc.doors.cli.main import main
from cloudrc.results.metrics.verdict import FlightFailure, FlightVerdict
from cloudrc.results.report.figures import FIGURES
from tests.doors.cli.conftest import FLY, SHORT
from tests.support.commands import python


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--mode local --seeds 3", "virtual time"),
        ("papper", "paper"),
        ("--set report.metrics=./no.py", "no.py': there is no such file"),
    ],
)
def test_bad_input_gives_one_line_and_writes_nothing(line, words, folder, refused):
    assert words in refused(f"run {line}")
    assert list(folder.iterdir()) == []


@pytest.mark.usefixtures("no_page")
def test_the_last_line_is_the_report_and_the_folder_is_complete(folder, call):
    lines = call(*FLY, "--seed", "7").out.splitlines()
    assert lines[0].startswith("steps: mode virtual, seed 7, link paper-p3")
    assert "SUCCESS: every step flown, every criterion met" in lines
    assert ["round", "trip,", "mean"] in [line.split()[:3] for line in lines]
    assert lines[-2] == "replay in 3-D: cloudrc replay runs/steps-virtual-seed7-1"
    page = folder / lines[-1]
    assert page == folder / "runs" / "steps-virtual-seed7-1" / "report.html"
    left = {path.name for path in page.parent.iterdir()}
    wanted = "report.html report.json mission.mcap config.yaml environment.json"
    assert set(wanted.split()) <= left
    assert (folder / "runs/latest/report.html").samefile(page)


WITHOUT_MATPLOTLIB = """
import sys
sys.modules["matplotlib"] = None
from cloudrc.doors.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_run_without_a_page_leaves_recording_and_numbers_and_needs_no_matplotlib(folder):
    done = python("-c", WITHOUT_MATPLOTLIB, *FLY, "--out", "a", "--report", "none")
    assert done.stdout.splitlines()[-1] == "a/report.json"
    names = {path.name for path in (folder / "a").iterdir()}
    assert names == {"report.json", "mission.mcap", "config.yaml", "environment.json"}


@pytest.mark.parametrize("line", ["run --report none", "report"])
def test_figures_are_files_if_they_are_asked_for(line, folder, monkeypatch, call):
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {"error": FIGURES["error"]})
    monkeypatch.setattr("cloudrc.results.report.figures.save", lambda *words: b"drawn elsewhere")
    call(*FLY, "--out", "a", "--report", "none", *["--figures"] * line.startswith("run"))
    if line == "report":
        call("report a --figures --width 3.5")
    names = {path.name for path in (folder / "a/figures").iterdir()}
    assert names == {"error.pdf", "error.png", "error.svg"}


@pytest.mark.usefixtures("no_page")
def test_a_run_and_its_report_can_be_repeated(folder, call, as_json):
    only_the_report = call(*FLY, "--seed", "3", "--out", "a", "-o", "json")
    assert only_the_report.out == (folder / "a/report.json").read_text()
    first = json.loads(only_the_report.out)
    again = as_json("run a/config.yaml --mode virtual --out b")
    assert first["records_sha256"] == again["records_sha256"]
    for name in ("report.json", "report.html"):
        (folder / "a" / name).unlink()
    assert call("report a").out.splitlines()[-1] == "a/report.html"
    assert (folder / "a/report.html").is_file()
    numbers = json.loads((folder / "a/report.json").read_text())["numbers"]
    assert numbers.keys() == first["numbers"].keys()
    # A recording has velocities in the body frame, so their last bit may change.
    for name, number in numbers.items():
        assert number["value"] == pytest.approx(first["numbers"][name]["value"], rel=1e-12), name


@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize(
    ("fails", "error", "code", "said"),
    [
        ("flight.fly.write_report", KeyboardInterrupt, 130,
         "to write its report: cloudrc report here"),
        ("results.report.write.write_json",
         OSError(28, "No space left on device", "here/report.json"), 3,
         "disk_full: here/report.json: free some space"),
    ],
)  # fmt: skip
def test_a_report_that_cannot_be_written_can_be_later(fails, error, code, said, monkeypatch, call):
    with monkeypatch.context() as changed:
        changed.setattr(f"cloudrc.{fails}", Mock(side_effect=error))
        assert said in call(*FLY, "--out", "here", code=code).err
    call("report here")


@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize("more", [(), ("--set", "fleet.robots=2")])
def test_a_flight_that_did_not_keep_real_time_ends_with_what_to_do(more, monkeypatch, call):
    slow = FlightVerdict("invalid", (FlightFailure("not_real_time", "it was too slow"),))
    monkeypatch.setattr("cloudrc.results.report.write.judge", lambda evidence: slow)
    said = call(*FLY, *more, code=6)
    assert said.out.splitlines()[-1].endswith("report.html")
    assert said.err.splitlines()[-1].endswith("or fly with --mode virtual")


@pytest.mark.usefixtures("no_page")
def test_a_closed_pipe_does_not_end_the_run(folder, monkeypatch):
    """As in `cloudrc run | head -1`; the exit code still follows the verdict, here 1."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed_pipe:
        monkeypatch.setattr("sys.stdout", closed_pipe)
        assert main([*FLY, "--out", "here", "--set", "criteria.time_limit_s=0.5"]) == 1
    assert (folder / "here" / "report.json").is_file()


FAILING = """
from cloudrc.cloud.predictors import Predictor
class Bad(Predictor):
    def predict(self, odometry, horizon):
        raise KeyError("oops")
def build() -> Bad:
    return Bad()
"""


@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize("how", ["--mode virtual", "--seeds 1"])
def test_a_failing_plug_in_fails_the_run_and_debug_shows_where(how, folder, call):
    (folder / "bad.py").write_text(FAILING)
    line = [f"run steps {how} --set cloud.predictor=./bad.py", *SHORT]
    shown = call(*line, code=1)
    assert "KeyError: 'oops', bad.py:5 in predict" in shown.out
    assert 'raise KeyError("oops")' not in shown.err
    assert 'raise KeyError("oops")' in call(*line, "--debug", code=1).err


def test_a_run_in_real_time_needs_the_extra_of_the_api(monkeypatch, refused):
    monkeypatch.setitem(requirements.EXTRAS, "api", ("fastapi_is_not_here",))
    assert "pip install 'cloudrc[api]'" in refused("run hover --mode local", code=3)
