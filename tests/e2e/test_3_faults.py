"""Pods are deleted in flight: cloud's mission goes on in the new pod, world's cannot."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator

import pytest

from cloudrc.cluster.release import wait_ready
from cloudrc.config.load import load_mission
from cloudrc.faults.cluster.pods import COMMANDS_IN, ENDS_IN, POD_START
from tests.e2e.conftest import (
    NAME,
    JobEnd,
    eventually,
    fly,
    job_end,
    job_log,
    kubectl,
    metrics,
    place,
    pod,
    pods,
    value,
)

PIPES = [waypoint.model_dump(mode="json") for waypoint in load_mission("pipes").waypoints]
LINGER = 12
"""For an old pod to stay beside the new one [s]."""


def fly_until(name: str, line: str, limit: float = 120.0) -> None:
    fly(name, PIPES, limit)
    eventually(lambda: line in job_log(name), f"{name}: {line}", 90.0)


def delete(component: str) -> str:
    """Delete a pod without waiting; its name."""
    name = str(pod(component)["metadata"]["name"])
    kubectl("delete", "pod", name, "--wait=false")
    return name


def new_pod(component: str, old: str) -> bool:
    return any(p["metadata"]["name"] != old for p in pods(component))


def lines(end: JobEnd, word: str) -> list[str]:
    return [line for line in end.log.splitlines() if word in line]


def check_resumed(end: JobEnd) -> None:
    """Complete, and no waypoint was reached twice or left out, across both pods."""
    assert (end.condition, end.exit_code) == ("Complete", 0), end
    for number in range(1, 8):
        assert len(lines(end, f"waypoint {number} of 7 reached")) == 1, end.log
    touched = {
        dict(labels)["body"]: number
        for (name, labels), number in metrics("world").items()
        if name == "cloudrc_contacts_total"
    }
    assert touched.pop("board") >= 1
    assert {body: number for body, number in touched.items() if "pipe" in body and number} == {}


def test_a_deleted_cloud_is_replaced_and_the_mission_goes_on(
    installed: None, note: Callable[[str], None]
) -> None:
    fly_until("bereft", "waypoint 2 of 7 reached")
    began, old = time.monotonic(), delete("cloud")
    eventually(lambda: new_pod("cloud", old), "a new cloud pod")
    eventually(lambda: guard() == "HOLD", "the robot holds", ENDS_IN, every=0.1)
    eventually(lambda: guard() == "TRACK", "the new cloud flies it", COMMANDS_IN + POD_START)
    note(f"cloud pod deleted in flight: flown again after {time.monotonic() - began:.1f} s")
    check_resumed(job_end("bereft"))


def guard() -> str:
    """State of the guard, by the world's own metrics."""
    states = {0: "GROUND", 1: "TRACK", 2: "HOLD", 3: "LAND", 4: "ESTOP"}
    return states[int(value(metrics("world"), "cloudrc_guard_state"))]


@pytest.fixture
def lingering() -> Iterator[None]:
    """Let a deleted cloud pod fly on for a while, as one on a node that is slow to hear of it."""
    deployment = f"deployment/{NAME}-cloud"
    hook = {"preStop": {"exec": {"command": ["sleep", str(LINGER)]}}}
    containers = [{"name": name, "lifecycle": hook} for name in ("cloud", "teleop")]
    spec = {"terminationGracePeriodSeconds": 3 * LINGER, "containers": containers}
    patch = json.dumps({"spec": {"template": {"spec": spec}}})
    kubectl("patch", deployment, f"--patch={patch}")
    wait_ready(place(), timeout=90.0)
    yield
    kubectl("rollout", "undo", deployment)
    wait_ready(place(), timeout=90.0)


@pytest.mark.full
def test_an_old_cloud_beside_the_new_one_does_no_harm(installed: None, lingering: None) -> None:
    fly_until("haunted", "waypoint 1 of 7 reached")
    old = delete("cloud")
    eventually(lambda: new_pod("cloud", old), "a new cloud pod")
    eventually(lambda: len(pods("cloud")) == 2, "both are there", 10.0)
    check_resumed(job_end("haunted"))


def test_a_deleted_world_ends_the_mission_as_failed(installed: None) -> None:
    fly_until("orphaned", "waypoint 1 of 7 reached")
    delete("world")
    end = job_end("orphaned", 90.0)
    assert (end.condition, end.exit_code) == ("Failed", 1), end
    assert "world_restarted" in end.message
    wait_ready(place(), timeout=60.0)
