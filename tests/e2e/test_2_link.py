"""The link of a release: delays, changes in flight, verdict."""

import json
import re
import time

import pytest
import yaml

from cloudrc.cluster.link import send_change
from cloudrc.link.follow import PROFILE, Handed
from tests.e2e import conftest as e2e

SET_WITHIN = 1.0
"""Time limit for `link set` until the change is in force [s]. The fastest of three calls counts,
because the machine also runs the cluster."""
TOLERANCE = 0.002
"""Tolerance of a mean one-way delay [s]."""
PROFILES = [
    ("paper-p1", 0.020, 8.0),
    pytest.param("paper-p3", 0.070, 20.0, marks=pytest.mark.full),
    ("paper-p2", 0.045, 10.0),
]
"""Profile, mean delay of each direction [s], time of the measurement [s]. In this time jitter alone
changes the mean by 0.2, 0.5 and 0.5 ms. The release starts with paper-p2."""
SETTLE = 1.0
"""Time after a change until the datagrams sent before the change have arrived [s]."""
INTERRUPTED = 130
"""Exit code of a mission that was cancelled."""
DIRECTIONS = {"uplink": "cloud", "downlink": "world"}
"""Direction -> end that measures its delay."""
LONG = [
    {"position_m": [0.5, 0.0, 0.7]},
    {"position_m": [0.5, 1.0, 0.7], "dwell_s": 200.0, "time_limit_s": 300.0},
]
"""A mission that waits at its second point for longer than the tests of this module take."""
LINK_TEST = f"{e2e.NAME}-test-link"
"""Pod of `helm test` that verifies the link; Helm keeps the pod after a failure."""


@pytest.fixture(scope="module")
def flight(installed):
    """A mission that flies while the profiles change, and is cancelled afterwards."""
    before = e2e.identity()
    e2e.fly("long", LONG, limit=300.0)
    e2e.eventually(lambda: "waypoint 1 of" in e2e.job_log("long"), "the robot is in the air", 60.0)
    yield
    assert e2e.read("job", "long")["status"].get("active") == 1, "it flies still"
    assert e2e.identity() == before, "a profile's change must not restart anything"
    e2e.in_release("mission", "cancel")
    end, _ = e2e.job_end("long", 30.0)
    assert (end.state, end.exit_code) == ("failed", INTERRUPTED), end


def counts(direction):
    """Return the sum [s] and the number of the one-way delays measured so far."""
    samples = e2e.metrics(DIRECTIONS[direction])
    name = f"cloudrc_{direction}_delay_seconds"
    return e2e.value(samples, f"{name}_sum"), e2e.value(samples, f"{name}_count")


def check_delays(wanted, seconds):
    """Check the mean delay of each direction [s] for some time [s]."""
    time.sleep(SETTLE)
    before = {direction: counts(direction) for direction in wanted}
    time.sleep(seconds)
    for direction, (total, number) in before.items():
        later_total, later_number = counts(direction)
        assert later_number - number > 50 * seconds, "datagrams arrive all the time"
        mean = (later_total - total) / (later_number - number)
        assert abs(mean - wanted[direction]) < TOLERANCE, direction


def changes(component):
    """Count the profiles that the link container of a pod has applied."""
    return e2e.kubectl("logs", e2e.pod_name(component), "-c", "link").count("in force")


def change_profile(name):
    before = {component: changes(component) for component in e2e.ENDS}
    e2e.helm("upgrade", e2e.NAME, str(e2e.CHART), "--reuse-values", f"--set=link.profile={name}")
    for end, number in before.items():
        # The kubelet updates volumes about once a minute; after a change of the pod, at once.
        note = f"cloudrc-e2e/profile={name}"
        e2e.kubectl("annotate", "pod", e2e.pod_name(end), "--overwrite", note)
        e2e.eventually(lambda e=end, n=number: changes(e) > n, f"{end}'s link follows", 90.0)


@pytest.mark.parametrize(("profile", "wanted", "seconds"), PROFILES)
def test_both_delays_are_the_profiles_within_two_milliseconds(flight, profile, wanted, seconds):
    change_profile(profile)
    check_delays(dict.fromkeys(DIRECTIONS, wanted), seconds)


def test_the_link_is_set_by_hand_and_read_back(flight):
    took = []
    try:
        for delay in (80, 120):
            told = e2e.set_link(f"downlink.delay_ms={delay}", "downlink.jitter_ms=0")
            took.append(told["seconds"])
        assert told["links"]["downlink"]["asked"]["delay"] == 0.12
        check_delays({"downlink": 0.12}, 5.0)
    finally:
        told = e2e.set_link("--profile", "paper-p2")
        took.append(told["seconds"])
    assert min(took) <= SET_WITHIN, took
    assert told["links"]["downlink"]["asked"]["delay"] == 0.045
    # Cloud notes a change of the downlink for its recording. The uplink has not changed.
    said = "link: downlink 45 ± 25 ms (profile paper-p2)"
    log = ("logs", e2e.pod_name("cloud"), "-c", "cloud")
    e2e.eventually(lambda: said in e2e.kubectl(*log), "cloud notes the change", 5.0)


@pytest.mark.full
def test_helm_test_refuses_a_link_whose_delay_was_doubled(flight):
    """Only cloud's link container gets the doubled delay; the profile of the release stays."""
    try:
        # Earlier datagrams are not judged after a change.
        told = e2e.set_link("downlink.delay_ms=46")
        profile = told["links"]["downlink"]["profile"]
        profile["downlink"]["delay_ms"] = 92
        change = {"number": str(time.time_ns()), "cause": "a seeded fault", "restart": False}
        handed = Handed(json.dumps(change), {PROFILE: yaml.safe_dump(profile)})
        state = json.loads(send_change(e2e.place(), e2e.pod_name("cloud"), handed))
        assert state["change"] == change["number"], state
        with pytest.raises(e2e.CommandFailedError):
            e2e.helm(
                "test", e2e.NAME, f"--filter=name={LINK_TEST}", "--timeout=300s", timeout=320.0
            )
        said = e2e.kubectl("logs", LINK_TEST)
    finally:
        e2e.set_link("--profile", "paper-p2")
        e2e.kubectl("delete", "pod", LINK_TEST, "--ignore-not-found", "--wait=false")
    assert "NOT BELIEVED" in said
    causes = set(re.findall(r"^ *(\w+): .*  \[(\w+)\]$", said, re.MULTILINE))
    assert causes - {("downlink", "throttled")} == {("downlink", "doubled_delay")}, said
