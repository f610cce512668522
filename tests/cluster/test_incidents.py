# SPDX-License-Identifier: Apache-2.0

"""What happens to pods in flight is told: events, killed containers."""

import pytest

from cloudrc.cluster.incidents import ReleaseWatch
from cloudrc.cluster.jobs import JobGoneError, follow, run_job
from tests.cluster.conftest import MISSION, OUT_OF_MEMORY, pod, terminated


@pytest.fixture
def watch(running, release):
    return ReleaseWatch(release)


@pytest.mark.parametrize(
    ("state", "words"),
    [
        (OUT_OF_MEMORY, "container 'cloud' of the cloud pod was killed, because it used "
         "more memory than its limit: raise cloud.resources.limits.memory"),
        (terminated(3, "starts\nport 9100 is taken\n"), "with exit code 3: port 9100 is taken"),
    ],
)  # fmt: skip
def test_a_container_that_ends_in_flight_is_told_once_with_its_cause(running, watch, state, words):
    assert list(watch.look()) == []
    running.put("pods", {**pod("cloud-1", "cloud", restarts=1, last=state), **kept(running)})
    (sentence,) = watch.look()
    assert words in sentence
    assert list(watch.look()) == []
    again = terminated(137, finishedAt="2026-01-01T00:09:00Z")
    running.put("pods", {**pod("cloud-1", "cloud", restarts=2, last=again), **kept(running)})
    assert len(list(watch.look())) == 1, "it was killed a second time"


def kept(api, name="cloud-1"):
    return {"metadata": api.get("pods", name)["metadata"]}


@pytest.mark.parametrize(
    ("kind", "reason", "told"),
    [
        ("Normal", "Killing", ["pod world-1: Killing: by somebody"]),
        ("Warning", "Evicted", ["pod world-1: Evicted: by somebody"]),
        ("Warning", "Unhealthy", []),
    ],
)
def test_what_kubernetes_says_of_a_pod_in_flight_is_told_once(running, watch, kind, reason, told):
    said = {"type": kind, "reason": reason, "message": "by\nsomebody"}
    running.tell_of("pods", "world-1", **said)
    assert list(watch.look()) == told
    assert list(watch.look()) == []


def gone(api, release):
    run_job(release, MISSION, name="first")
    api.start_pod("first")
    api.logs["first-x"] = "waypoint 1 of 2 reached\n"
    return api.get("jobs", "first")


def delete(api):
    api.objects.pop(("jobs", "first"))


def time_out(api):
    api.start_pod("first", state=terminated(143, "this watcher is stopped"))
    api.end("first", "Failed", reason="DeadlineExceeded", message="too long")


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (delete, "its Job was deleted"),
        (time_out, "its Job has ended without a verdict: DeadlineExceeded: too long"),
    ],
)
def test_a_job_that_is_gone_is_not_an_error_of_the_api(running, release, action, words):
    job = gone(running, release)
    running.at_look(3, lambda: action(running))
    with pytest.raises(JobGoneError) as told:
        follow(release, "first", print)
    assert (str(told.value), told.value.key) == (words, job["metadata"]["uid"])
