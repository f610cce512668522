# SPDX-License-Identifier: Apache-2.0

"""The folder of a run gives the same report again, or an error, and then stays unchanged."""

import json
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.resolved import dump
from cloudrc.results.metrics.verdict import exit_code
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.document import Run
from cloudrc.results.report.folder import read_run
from cloudrc.results.report.summary import summarize
from cloudrc.results.report.write import write_report
from tests.results.metrics.conftest import good, paper
from tests.results.record.conftest import rewrite, write, write_mission

RUN = Run("virtual", "virtual", notes=("seen",), physics_steps="C")


@pytest.fixture(scope="module")
def flown_once(tmp_path_factory):
    """The folder of a run in virtual time, with its report."""
    folder, (world, cloud) = tmp_path_factory.mktemp("run"), good().ends()
    (folder / "config.yaml").write_text(dump(paper()[0]))
    write_report(folder, Recording.from_records(world, cloud), paper()[0], RUN, page=False)
    kept = {name: (folder / name).read_bytes() for name in ("config.yaml", "report.json")}
    write_mission(folder / "mission.mcap", world, cloud, attachments=kept, metadata=RUN.metadata)
    return folder


@pytest.fixture
def run(flown_once, tmp_path):
    return shutil.copytree(flown_once, tmp_path / "run")


def report(folder):
    return json.loads((folder / "report.json").read_text())


def cut(source, target):
    target.write_bytes(source.read_bytes()[: source.stat().st_size // 2])


def recorded(config):
    """Record again, with another experiment."""

    def change(source, target):
        world, cloud = good().ends()
        write_mission(target, world, cloud, attachments={"config.yaml": config})

    return change


OTHER = b"seed: 2\nmission: pipes\n"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            partial(rewrite, keep=lambda c, m: c.topic in ("/odometry", "/cmd_vel")),
            "it holds 0 of 401 on /telemetry, .* and 12 more",
        ),
        (cut, "cut short: .* but report.json describes the whole"),
        (recorded(OTHER), "is the recording of an experiment with other values for: "),
    ],
)
def test_an_insufficient_recording_is_refused(run, refused, change, said):
    (run / "report.html").write_text("the page")
    change(run / "mission.mcap", run / "n.mcap")
    (run / "n.mcap").replace(run / "mission.mcap")
    before = {path: path.read_bytes() for path in run.glob("*.*")}
    assert re.search(said, refused("report", run))
    assert {path: path.read_bytes() for path in run.glob("*.*")} == before


def test_a_torn_recording_has_a_report_that_says_so(run):
    (run / "report.json").unlink()
    cut(run / "mission.mcap", run / "mission.mcap")
    found = write_report(run, *read_run(run), page=False)
    assert (found["verdict"], found["complete"], exit_code(found)) == ("invalid", False, 6)
    assert found["notes"][0].startswith("The recording is incomplete: cut short")
    assert 0 < found["numbers"]["duration"]["value"] < 10
    assert "records_sha256" not in found
    assert summarize(found).startswith("INVALID (recording incomplete): ")


@pytest.mark.parametrize("was_interrupted", [False, True])
def test_a_run_whose_end_is_lost_is_invalid_unless_it_was_interrupted(run, was_interrupted):
    (run / "report.json").unlink()
    mission, facts = run / "mission.mcap", replace(RUN, interrupted=was_interrupted)
    recording = Recording.read(mission)
    recording.metadata |= facts.metadata
    recording.write(mission)  # the facts about the run come first
    cut(mission, run / "torn.mcap")
    Recording.read(run / "torn.mcap").write(mission)
    found = write_report(run, *read_run(run), page=False)
    verdict = "interrupted" if was_interrupted else "invalid"
    assert (found["verdict"], exit_code(found)) == (verdict, 130 if was_interrupted else 6)
    assert "seen" in found["notes"]
    text = found["failures"][0]["text"]
    assert was_interrupted or re.search(r"not known .*: all lost from \d\.\d\d s on", text)


def write_ends(folder):
    """Record the flight as the processes of world and cloud do."""
    for end, records in zip(("world", "cloud"), good().ends(), strict=True):
        write(folder / f"{end}.mcap", records, end, "same")


def test_the_recordings_are_merged_if_they_are_not_yet(run):
    write_ends(run)
    first = report(run)["numbers"]
    for what in (Path.unlink, lambda path: path.write_bytes(b"")):
        what(run / "mission.mcap")
        recording, experiment, facts = read_run(run)
        assert facts.interrupted, "the command was killed before it wrote mission.mcap"
        assert write_report(run, recording, experiment, facts, page=False)["numbers"] == first
        assert Recording.read(run / "mission.mcap").note == ""


def test_a_folder_without_a_run_is_refused(run):
    for name in ("mission.mcap", "config.yaml"):
        (run / name).unlink()
        with pytest.raises(BadInputError, match=f"{name}: no such file"):
            read_run(run)
