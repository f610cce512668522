# SPDX-License-Identifier: Apache-2.0

"""Missions of a fleet on the fake API server: one Job, one watch, one summary."""

import json
from itertools import cycle

import pytest

from cloudrc.cluster import fleet_mission, jobs
from cloudrc.cluster.fleet_mission import follow_fleet
from cloudrc.cluster.jobs import run_job
from cloudrc.teleop.client import ALL_MET
from tests.cluster.conftest import MISSION

HEAD = "time_s,direction,packets,size,busy_ns,waited_ns,longest_ns,most,dropped,dropped_by\n"
BEFORE = "0.1,uplink,9,90,90000000,0,0,1,0,\n"
ROW = "uplink,10,100,100000000,900000000,99000000,50,6,1:4 2:2"
TEXTS = {"timed_out": "too late; also no_code: 1", "not_settled": "1 m"}
FAILURES = [{"code": code, "text": text} for code, text in TEXTS.items()]
FLIGHT = "".join(f"0.{tenth},{ROW}\n" for tenth in range(2, 10))


@pytest.fixture
def flown(fleet, release, monkeypatch):
    """Fly a mission with N robots, of which number 1 fails; return lines, end and requests."""
    monkeypatch.setattr(fleet_mission.time, "sleep", lambda seconds: None)
    pages, records = [], cycle([HEAD + BEFORE, HEAD + BEFORE + FLIGHT])

    def page(release, pod, port):
        pages.append(pod)
        age = 10.0 * (pages.count(pod) - 1)
        return f"""cloudrc_command_age_seconds_sum {age / 5}
cloudrc_command_age_seconds_count {age}
cloudrc_guard_held_seconds_total {age / 10}
"""

    monkeypatch.setattr(fleet_mission, "read_page", page)
    monkeypatch.setattr(fleet_mission, "run", lambda program, words: next(records))

    def fly(robots):
        api, lines = fleet(robots), []
        name = run_job(release, MISSION)
        for robot in range(robots):
            code = int(robot == 1)
            verdict = {"outcome": "failure" if code else "success", "exit_code": code}
            failures = FAILURES if code else []
            api.end_robot(name, robot, code, json.dumps({**verdict, "failures": failures}))
        api.end(name, "Complete")
        api.seen.clear()
        return lines, follow_fleet(release, name, lines.append), list(api.seen)

    return fly


def test_a_fleet_ends_with_a_verdict_per_robot_and_a_summary_that_names_the_cell(flown):
    lines, ended, _ = flown(3)
    assert ended.exit_code == 1
    assert lines[1:4] == [
        f"robot 0: SUCCESS: {ALL_MET}",
        "robot 1: FAILURE: timed_out: too late; also no_code: 1; also not_settled: 1 m",
        f"robot 2: SUCCESS: {ALL_MET}",
    ]
    summary = "\n".join(lines)
    assert "FAILURE: 1 of 3 robots did not succeed: robot 1 (timed_out, not_settled)" in summary
    assert summary.count("200") == 5, "ms, mean age of the commands; also of median and worst"
    assert "cell overloaded: uplink, load 1.6" in summary


def test_the_cell_may_begin_a_new_record_in_flight(flown, monkeypatch):
    """Its recording is full, or its pod is a new one; the summary has what it knows."""
    records = cycle([HEAD + BEFORE, HEAD + FLIGHT])
    monkeypatch.setattr(fleet_mission, "run", lambda program, words: next(records))
    assert "cell overloaded: uplink, load 1.6" in "\n".join(flown(3)[0])


def test_the_number_of_requests_does_not_grow_with_that_of_robots(flown):
    assert len(flown(3)[2]) == len(flown(50)[2]) < 20


def test_the_job_flies_as_many_robots_as_there_are_now_and_together(fleet, release):
    api = fleet(3)
    api.get("statefulsets", "cloudrc-world")["spec"]["replicas"] = 4  # kubectl scale
    job = api.get("jobs", run_job(release, MISSION))
    assert (job["spec"]["completions"], job["spec"]["parallelism"]) == (4, 4)
    (owner,) = job["metadata"]["ownerReferences"]
    assert owner["kind"] == "StatefulSet"
    arguments = job["spec"]["template"]["spec"]["containers"][0]["args"]
    assert sum(word.startswith(jobs.AT) for word in arguments) == 1


def test_other_verbs_need_the_number_of_a_robot(fleet, refused):
    fleet(3)
    said = refused("mission status --release cloudrc", code=2)
    assert "has 3 robots; name one: --robot K" in said
