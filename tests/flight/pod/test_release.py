# SPDX-License-Identifier: Apache-2.0

"""World, cloud and teleop as processes that are killed, frozen or ended in flight."""

import signal
import time

import pytest

from cloudrc.results.record.columns import Recording
from cloudrc.teleop.client import Api, UnreachableError
from tests.conftest import nightly
from tests.flight.conftest import LIMIT, TOKEN, Release, ages_at_hold

pytestmark = pytest.mark.process


@pytest.fixture
def release(tmp_path):
    one = Release(tmp_path)
    yield one
    one.end()


@pytest.mark.parametrize("killed", [("cloud", "teleop"), *nightly(("teleop",), ("cloud",))])
def test_the_mission_goes_on_at_the_same_waypoint(release, killed):
    """Before, cloud stands still: nothing that it has computed before is flown."""
    release.fly()
    release.freeze("cloud", 0.5)
    release.kill(*killed)
    for name in killed:
        release.start(name)
    release.until(lambda: release.mission()["state"] == "done")
    view = release.ask(f"/v1/missions/{release.mission()['id']}")
    assert [reached["waypoint"] for reached in view["reached"]] == [0, 1, 2]
    # A busy machine is no failure of this test.
    assert {failure["code"] for failure in view["verdict"]["failures"]} <= {"not_real_time"}
    names = [event["event"] for event in view["events"]]
    assert names.count("started") == 1
    assert names.count("resumed") == ("teleop" in killed)
    assert ("new_session" in names) == (killed == ("cloud",))  # a new teleop knows no other session
    release.stop()
    flown = Recording.read(release.folder / "world.mcap")
    ages, applied = ages_at_hold(flown), flown["/command_applied"]
    assert ages
    assert all(0.25 < age <= 0.252 + 1e-9 for age in ages)
    assert (applied["stamp_ns"] - applied["basis_stamp_ns"]).max() <= 252_000_000


@pytest.mark.fault(
    33,
    "shutdown",
    injects="SIGTERM of teleop in a mission",
    expects="teleop holds the robot, then ends; its successor resumes the mission",
    figures="exit within 2 s",
)
def test_an_ended_teleop_holds_and_its_waiting_successor_resumes(release):
    release.fly()
    first, old = release.running["teleop"], release.url
    release.start("teleop")
    release.until((release.folder / "api.json").exists)
    assert release.url != old
    with pytest.raises(UnreachableError, match="another teleop has this journal open"):
        Api(release.url, lambda: TOKEN).get("/v1/state")
    first.send_signal(signal.SIGTERM)
    first.communicate(timeout=2.0)
    assert first.returncode == 0
    release.until(lambda: release.mission()["state"] == "done")
    mission = release.ask(f"/v1/missions/{release.mission()['id']}")
    assert [reached["waypoint"] for reached in mission["reached"]] == [0, 1, 2]
    paused = [event["text"] for event in mission["events"] if event["event"] == "paused"]
    assert ["paused by shutdown" in text for text in paused] == [True]


@pytest.mark.promise("emergency-stop-gets-through")
def test_an_emergency_stop_stops_the_rotors_and_fails_the_job(release):
    job = release.fly()
    release.post("/v1/estop")
    release.until_guard("ESTOP")
    out, _ = job.communicate(timeout=LIMIT)
    assert job.returncode == 1
    assert "emergency_stopped" in out.splitlines()[-1]
    release.post("/v1/acknowledge")
    release.until(lambda: release.ask("/v1/state")["seen"]["guard"] != "ESTOP")


def test_a_pod_that_ends_in_flight_holds_the_robot_by_its_word(release):
    """Cloud gets the signal first, when teleop has not sent its hold yet."""
    release.fly()
    release.stop("cloud", "teleop")
    assert [release.running[name].returncode for name in ("cloud", "teleop")] == [0, 0]
    time.sleep(0.5)  # without commands the robot also holds, after 0.25 s
    (said,) = release.stop("world")
    assert [line for line in said.splitlines() if "HOLD" in line] == ["guard: HOLD, mission ended"]
