# SPDX-License-Identifier: Apache-2.0

"""Faults in flight: pods and a Job deleted, a rotated key."""

import base64
import json
import subprocess
import sys
import time

import pytest

from cloudrc.cluster.pods import fetch_recording
from cloudrc.doors.cli.mission import LEASE
from cloudrc.results.record.columns import Recording
from cloudrc.wire.messages import GuardState
from tests.e2e.conftest import (
    NAME,
    PIPES,
    eventually,
    fly,
    job_end,
    job_log,
    kubectl,
    metrics,
    place,
    pod,
    pods,
    read,
    until_ready,
    value,
)
from tests.flight.conftest import ages_at_hold

pytestmark = pytest.mark.real_time

LINE = [{"position_m": [0.5, 0.0, 0.7]}, {"position_m": [0.5, 2.5, 0.7], "dwell_s": 3.0}]
"""Two waypoints; from one to the other the robot flies for some seconds."""
ENDS_IN = 2.0
"""Time limit for a deleted pod to end, and for its robot to hold [s].
Source: docs/reference/faults.md, "F33"."""
COMMANDS_IN = 2.0
"""Time limit for a new cloud to send commands [s]. Source: docs/reference/faults.md, "F13"."""
POD_START = 10.0
"""Time that Kubernetes needs to replace a pod whose image is on the node [s]. On kind with two busy
CPUs, 6.3 to 9.5 s were measured from the pod's deletion to the flight."""


@pytest.fixture(scope="module", autouse=True)
def _no_mission_is_left(installed):
    """A deleted Job cancels its mission, which would block the tests after a failed one."""
    yield
    kubectl("delete", "jobs", "--all")


def guard():
    """Return the state of the guard from world's metrics."""
    return GuardState(int(value(metrics("world"), "cloudrc_guard_state"))).name


def fly_until(name, line, **mission):
    fly(name, limit=120.0, **(mission or PIPES))
    eventually(lambda: line in job_log(name), f"{name}: {line}", 90.0)


def replace(component):
    """Delete a pod, and wait only until a new pod exists."""
    old = pod(component)["metadata"]["name"]
    kubectl("delete", "pod", old, "--wait=false")
    eventually(lambda: any(p["metadata"]["name"] != old for p in pods(component)), "a new pod")


def check_completed(name, points=7):
    """Check that the Job completes, and reaches each waypoint once."""
    end, log = job_end(name)
    assert end.exit_code == 0, end
    for number in range(1, points + 1):
        assert log.count(f"waypoint {number} of {points} reached") == 1, log


def check_touched(name):
    """Check that the Job completes, and touches the board alone."""
    check_completed(name)
    touched = {
        dict(labels)["body"]: number
        for (name, labels), number in metrics("world").items()
        if name == "cloudrc_contacts_total"
    }
    assert touched.pop("board") >= 1
    assert touched.keys() <= {"floor"}


@pytest.mark.fault(
    14,
    "cloud-evicted",
    injects="the cloud pod is deleted in flight",
    expects="HOLD; the new cloud commands, and the mission goes on",
    figures="HOLD within 2 s",
)
def test_a_deleted_cloud_is_replaced_and_the_mission_goes_on(installed, note):
    fly_until("bereft", "waypoint 1 of 2 reached", waypoints=LINE)
    began = time.monotonic()
    replace("cloud")
    eventually(lambda: guard() == "HOLD", "the robot holds", ENDS_IN, every=0.1)
    eventually(lambda: guard() == "TRACK", "the new cloud flies it", COMMANDS_IN + POD_START)
    note(f"cloud pod deleted in flight: flown again after {time.monotonic() - began:.1f} s")
    check_completed("bereft", 2)


@pytest.mark.full
def test_a_deleted_world_ends_the_mission_as_failed(installed):
    fly_until("orphaned", "waypoint 1 of 7 reached")
    replace("world")
    end, _ = job_end("orphaned")
    assert end.exit_code == 1, end
    assert "world_restarted" in end.message
    until_ready()


def recording(component, folder):
    """Fetch the recording of an end as it is now."""
    time.sleep(1.0)  # the recorder's flush
    path = folder / f"{component}.mcap"
    fetch_recording(place(), component, path)
    return Recording.read(path)


@pytest.mark.full
def test_a_mission_outlives_its_watcher(installed):
    fly_until("watched", "waypoint 2 of 7 reached")
    kubectl("delete", "pod", "--selector=batch.kubernetes.io/job-name=watched")
    check_touched("watched")


@pytest.mark.full
@pytest.mark.fault(
    33,
    "operator-lost",
    injects="the Job of the mission is deleted",
    expects="the mission ends with its lease, and the robot holds; the next mission flies",
)
def test_a_mission_whose_job_is_deleted_is_cancelled(installed):
    fly("leaderless", [{"position_m": [0.5, 0.0, 0.7], "dwell_s": 1000.0}], 2000.0)
    eventually(lambda: guard() == "TRACK", "the mission flies", 60.0)
    kubectl("delete", "job", "leaderless")
    assert guard() == "TRACK", "the mission ends with its lease"
    eventually(lambda: guard() == "HOLD", "the robot holds", LEASE + 10.0)
    fly("successor", **PIPES, limit=120.0)
    check_touched("successor")


@pytest.mark.full
@pytest.mark.fault(
    38,
    "secret-rotated",
    injects="the Secret with the key is replaced while missions fly",
    expects="both ends use the new key; the missions succeed",
    figures="at most 1 HOLD",
)
def test_a_rotated_key_costs_one_hold_at_most(installed, tmp_path):
    secret = f"{NAME}-tunnel"
    key = tmp_path / "key"
    key.write_bytes(base64.b64decode(read("secret", secret)["data"]["key"]))
    key.chmod(0o600)
    subprocess.run([sys.executable, "-m", "cloudrc", "key", "new", str(key)], check=True)
    before = len(ages_at_hold(recording("world", tmp_path)))
    data = {"data": {"key": base64.b64encode(key.read_bytes()).decode()}}
    kubectl("patch", "secret", secret, f"--patch={json.dumps(data)}")
    for number in range(4):  # a Secret reaches a pod within two minutes
        fly_until(f"rekeyed-{number}", "waypoint 1 of 7 reached")
        check_touched(f"rekeyed-{number}")
    assert len(ages_at_hold(recording("world", tmp_path))) - before <= 1
    for component in ("world", "cloud"):
        texts = recording(component, tmp_path)["/fault"]["text"].tolist()
        assert any("new key" in text for text in texts)
