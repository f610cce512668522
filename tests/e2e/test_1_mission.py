# SPDX-License-Identifier: Apache-2.0

"""A release in a restricted namespace flies the paper's mission by a Job; metrics and access."""

import math
import re
import time
from types import SimpleNamespace

import pytest

from tests.e2e.conftest import (
    NAME,
    PIPES,
    TIMES,
    eventually,
    fly,
    job_end,
    job_log,
    kubectl,
    metrics,
    pod,
    report,
    scrapes,
    value,
)
from tests.e2e.neighbours import promtool, queries, stranger

MISSION = "paper-mission"
LIMIT_TIME = 360.0
"""Time limit from `kind create cluster` to the completed Job [s]."""
PORTS = {"world": (9100, 9102), "cloud": (8080, 9100, 9101, 9102)}


@pytest.fixture(scope="module")
def first(prometheus):
    """Observations of the first mission; two counts of malformed datagrams, by their sender."""
    fly(MISSION, **PIPES, limit=180.0)
    eventually(lambda: "waypoint 1 of 7" in job_log(MISSION), "the mission flies", 60.0)
    tried = {
        "tcp": [(ip(component), port) for component, ports in PORTS.items() for port in ports],
        "udp": [(ip("world"), 7400), (ip("cloud"), 7400)],
    }
    opened = stranger("stranger", tried)
    foreign_malformed = malformed()
    paper, log = job_end(MISSION)
    seconds = time.monotonic() - TIMES["create"]
    # Show that such a datagram is counted: the cloud pod may send to world's tunnel.
    code = (
        "import socket; s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM);"
        f" s.sendto(b'not a datagram', ('{ip('world')}', 7400))"
    )
    kubectl("exec", pod("cloud")["metadata"]["name"], "-c", "cloud", "--", "python", "-c", code)
    counts = {"foreign_malformed": foreign_malformed, "own_malformed": malformed()}
    return SimpleNamespace(paper=paper, log=log, opened=opened, seconds=seconds, **counts)


def ip(component):
    return str(pod(component)["status"]["podIP"])


def malformed():
    """Count the malformed datagrams that have reached both ends."""
    name, outcome = "cloudrc_datagrams_total", "malformed"
    time.sleep(1.2)  # the metric is updated once a second
    return sum(value(metrics(end), name, outcome=outcome) for end in ("world", "cloud"))


@pytest.mark.real_time
def test_the_papers_mission_ends_complete(first, note):
    note(f"from 'kind create cluster' to a Job that is Complete: {first.seconds:.0f} s")
    assert first.paper.exit_code == 0, first.paper
    assert first.seconds < LIMIT_TIME
    for number in range(1, 8):
        assert first.log.count(f"waypoint {number} of 7 reached") == 1
    assert "success" in first.paper.message.lower()


def test_kubectl_describe_shows_the_verdict(first):
    described = kubectl("describe", f"--selector=batch.kubernetes.io/job-name={MISSION}", "pod")
    assert f'"exit_code": {first.paper.exit_code}' in described


@pytest.mark.real_time
def test_the_last_mission_of_a_release_without_a_volume_has_a_report(first, tmp_path):
    found = report(tmp_path / "last", NAME)
    assert (found["verdict"], found["complete"]) == ("success", True)
    assert found["numbers"]["waypoints_reached"]["value"] == 7


def test_a_stranger_reaches_neither_tunnel_nor_metrics_nor_api(first):
    assert first.opened == []
    assert first.foreign_malformed == 0
    assert first.own_malformed >= 1, "a datagram that arrives is counted"


def test_all_metrics_are_well_formed_and_of_one_configuration(first):
    texts = scrapes("world") | scrapes("cloud")
    for container, text in texts.items():
        assert promtool("check", "metrics", given=text) == "", container
    found = {name: re.findall(r'build_info{config="(\w*)"', text) for name, text in texts.items()}
    assert set(found) == {"world", "cloud", "teleop", "link"}
    assert len({tuple(config) for config in found.values()}) == 1, found
    assert len(found["world"][0]) == 12


@pytest.fixture(scope="module")
def asked(first):
    with queries() as ask:
        yield ask


def mean(name):
    return f"sum(cloudrc_{name}_seconds_sum) / sum(cloudrc_{name}_seconds_count)"


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("query", "series", "low", "high"),
    [
        ("max by (component) (up)", 2, 1, 1),
        ("max_over_time(max by (axis) (abs(cloudrc_estimate_error_meters))[2m:2s])", 3, 0, 0.5),
        ("max_over_time(max by (axis, term) (abs(cloudrc_pid_output))[2m:2s])", 9, 0, 6.0),
        (mean("uplink_delay"), 1, 0.04, 0.05),
        (mean("downlink_delay"), 1, 0.04, 0.05),
        (mean("rtt"), 1, 0.05, 0.1),
        ("min(min_over_time(cloudrc_real_time_factor[1m]))", 1, 0.95, 1.05),
    ],
    ids=["pods", "estimate error", "PID terms", "uplink", "downlink", "rtt", "real time"],
)
def test_prometheus_answers(asked, query, series, low, high):
    answers = [float(sample["value"][1]) for sample in asked(query)]
    assert len(answers) == series
    assert all(math.isfinite(a) and low <= a <= high for a in answers), answers
