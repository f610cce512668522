# SPDX-License-Identifier: Apache-2.0

"""The Job of a mission keeps a report beside the recordings that the pods still write."""

import os
import time
from collections import Counter
from unittest.mock import Mock

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.cluster import kept
from cloudrc.cluster.client import Release
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.merge import cut_to_last_mission, merge
from cloudrc.results.report.folder import read_run
from cloudrc.teleop.store import MissionRecord
from tests.cluster.test_flight import flown, record
from tests.results.record.conftest import later

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
EXPERIMENT = "link: {profile: paper-p2}\nworld: {scene: pipes}\n"


@pytest.fixture
def data(tmp_path, monkeypatch):
    """The volume after a flight and, an hour later, another one."""
    monkeypatch.setattr(kept, "FLUSH", 0.0)
    second = tuple(later(each, HOUR) for each in flown())
    record(tmp_path, flown(), second, torn=True)
    (tmp_path / "experiment.yaml").write_text(EXPERIMENT)
    (tmp_path / "profile.yaml").write_text("profile: paper-p3\n")
    return tmp_path


def keep(data, mission, count=9, days=1.0, size=1e9):
    files = data / "experiment.yaml", data / "profile.yaml"
    order = {"name": "x", "time_limit_s": 77.0, "waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}
    view = {"id": mission, "events": [{"time_s": 5.0}]}
    return kept.keep_report(data, files, order, view, kept.Retention(count, days, size))


def test_a_kept_report_is_a_run_of_the_last_mission_and_of_the_links_profile(data):
    recording, experiment, run = read_run(keep(data, "m2"))
    assert experiment.mission.waypoints[0].position_m == (0.5, 0.0, 1.0)
    assert (experiment.uplink.delay_ms, experiment.criteria.time_limit_s) == (70.0, 77.0)
    assert (experiment.name, run.mode, run.shaper) == ("x", "cluster", "relay")
    assert recording["/mission"]["event"].tolist().count("started") == 1
    assert recording["/mission"]["stamp_ns"][0] > HOUR


def test_the_waypoints_of_a_robot_on_the_ground_have_its_height(data):
    (data / "experiment.yaml").write_text("world: {robot: rover, scene: pillars}\n")
    order = {"waypoints": [{"position_m": [1.5, 1.2]}]}
    found = kept._experiment(data / "experiment.yaml", data / "profile.yaml", order)
    assert found.mission.waypoints[0].position_m == (1.5, 1.2, 0.1)


def test_a_report_of_another_install_is_told_by_the_missions_number(data, tmp_path, monkeypatch):
    """An earlier install, whose volume this is, has flown a mission of the same id."""
    there = keep(data, "m1")
    number = int(Recording.read(there / "mission.mcap")["/telemetry"]["mission_id"][-1])
    known = MissionRecord("m1", Mock(), number, state="done", happened=Counter(started=1))
    pods = Mock()
    monkeypatch.setattr(kept, "_missions", lambda release: {"m1": known})
    monkeypatch.setattr(kept, "_report_of_pods", pods)
    monkeypatch.setattr(kept, "find_pod", Mock())
    monkeypatch.setattr(kept, "list_files", lambda *where: [there.name])

    def copy(release, pod, container, path, target):
        target.write_bytes((there / target.name).read_bytes())

    monkeypatch.setattr(kept, "copy_file", copy)
    release = Release(None, "lab", "cloudrc")
    for folder in ("own", "foreign"):
        (found := tmp_path / folder).mkdir()
        kept.fetch_mission(release, "m1", found, print)
        assert (pods.called, bool([*found.iterdir()])) == (folder == "foreign", folder == "own")
        known.number += 1
    known.state = "flying"
    with pytest.raises(BadInputError, match="mission m1 has not ended; wait for its end"):
        kept.fetch_mission(release, "m1", found, print)


def test_the_oldest_reports_go(data, monkeypatch):
    monkeypatch.setattr(kept, "report_flight", lambda *given, **wanted: None)
    names = [keep(data, f"m{number}", count=2).name for number in range(3)]
    kept_now = sorted(each.name for each in (data / "missions").iterdir())
    assert kept_now == names[1:]
    old = time.time() - 2 * kept.DAY
    os.utime(data / "missions" / names[1], (old, old))
    keep(data, "m8")
    assert not (data / "missions" / names[1]).exists()
    assert [keep(data, "m9", size=0.0)] == [*(data / "missions").iterdir()]


def test_the_end_of_a_long_recording_is_read_in_little_memory(data, monkeypatch):
    monkeypatch.setattr("cloudrc.results.record.reader.TRIM_EVERY", 100)
    whole = Recording.read(data / "cloud.mcap")
    end = Recording.read(data / "cloud.mcap", last_ns=60 * SECOND)
    assert len(end.messages) < 0.6 * len(whole.messages)
    assert end.messages == whole.messages[-len(end.messages) :]


def test_a_mission_is_found_by_its_number(data):
    mission = merge(data / "world.mcap", data / "cloud.mcap")
    number = int(mission["/telemetry"]["mission_id"].max())
    assert cut_to_last_mission(mission, being_written=True, number=number)
    assert mission["/mission"]["stamp_ns"].max() < HOUR
