# SPDX-License-Identifier: Apache-2.0

"""`cloudrc see`: a perception looks again at what a recorded flight saw."""

import json
from pathlib import Path

import pytest

from cloudrc.doors.cli.main import main
from cloudrc.results.record.columns import Recording
from tests.support.camera import needs_renderer

TURNS_AWAY = """
from cloudrc.cloud.perceptions import Perception
from cloudrc.wire.messages import Setpoint

class Away(Perception):
    takes = "{}"
    def see(self, seen, odometry):
        x, y, z = odometry.position
        if seen.stamp_ns % 4 == 0:
            return 1 / 0
        return Setpoint((x - 100.0, y, z))

def build():
    return Away()
"""


def seen(call, words):
    return json.loads(call(f"see a {words} -o json").out)


@pytest.fixture
def gap():
    mission = "mission.waypoints=[{position_m: [2, 0], tolerance_m: 0.5}]"
    fly = ["run", "gap", "--mode", "virtual", "--report", "none", "--out", "a"]
    assert main([*fly, "--set", mission]) == 0


@pytest.mark.usefixtures("gap", "no_page")
def test_the_same_perception_makes_the_setpoints_of_the_flight_again(call):
    summary = seen(call, "")["summary"]
    assert summary["seen"] > 10
    assert summary["setpoints_flown"] >= summary["seen"] - 3
    assert summary["apart_max_m"] == 0.0
    assert "0 failed" in call("see a").out


@pytest.mark.usefixtures("gap", "no_page")
def test_another_one_is_compared_and_its_failures_are_counted(call, folder):
    (folder / "away.py").write_text(TURNS_AWAY.format("scan"))
    found = seen(call, "--perception away.py")
    assert found["summary"]["failed"] > 0
    assert {each["error"].partition(":")[0] for each in found["looks"]} <= {"", "ZeroDivisionError"}
    made = [look["setpoint_m"] for look in found["looks"] if look["setpoint_m"]]
    assert all(x == pytest.approx(-1.75) for x, _, _ in made), "cloud brings it into the fence"
    (folder / "away.py").write_text(TURNS_AWAY.format("camera"))
    assert "has no pictures" in call("see a --perception away.py", code=2).err


@needs_renderer
@pytest.mark.usefixtures("no_page")
def test_pictures_that_are_kept_are_seen_again(call):
    fly = "run follow --mode virtual --report none --out a --set mission.follow.duration_s=2"
    assert "the target out of view for 0.0% of the time" in call(fly).out
    summary = seen(call, "--perception target")["summary"]
    assert summary["seen"] == pytest.approx(30, abs=3)
    assert summary["apart_max_m"] == 0.0


@needs_renderer
@pytest.mark.usefixtures("no_page")
def test_each_of_several_pictures_that_came_at_one_time_is_seen(call):
    fly = ["run", "follow", "--mode", "virtual", "--report", "none", "--out", "a"]
    link = "link.uplink={delay_ms: 300, jitter_ms: 200, keep_order: true}"
    assert main([*fly, "--set", "mission.follow.duration_s=1", "--set", link]) == 0
    shown = Recording.read(Path("a/mission.mcap"))["/frame_shown"]["stamp_ns"].tolist()
    assert len(set(shown)) < len(shown)
    assert seen(call, "")["summary"]["apart_max_m"] == 0.0
