"""The Job of a sweep is created once, its log is read, and its failures are named."""

import base64
import subprocess

import pytest

from cloudrc import __version__
from cloudrc.cluster import batch
from cloudrc.cluster.batch import PodSettings
from cloudrc.cluster.jobs import UID_LABEL
from cloudrc.errors import BadInputError
from tests.cluster.conftest import pod, terminated

PODS = PodSettings(4, "my/world:1", "1")


@pytest.fixture
def started(api, release):
    batch.start(release, "sweep-1", b"flights", PODS)
    return api


def add_pod(api, name, phase, log="", **given):
    labels = {UID_LABEL: api.get("jobs", "sweep-1")["metadata"]["uid"]}
    api.put("pods", pod(name, "sweep", labels=labels, phase=phase, **given))
    api.logs[name] = log


def lines(release):
    told = []
    return [*batch.read_lines(release, "sweep-1", told.append)], told


def test_the_job_flies_each_index_with_its_flights(started, api, release):
    job, data = api.get("jobs", "sweep-1"), api.get("configmaps", "sweep-1")
    assert base64.b64decode(data["binaryData"]["flights.json.gz"]) == b"flights"
    assert data["metadata"]["ownerReferences"][0]["uid"] == job["metadata"]["uid"]
    spec = job["spec"]
    assert (spec["completionMode"], spec["completions"], spec["parallelism"]) == ("Indexed", 4, 4)
    (container,) = spec["template"]["spec"]["containers"]
    assert container["image"] == "my/world:1"
    run = [*container["command"], *container["args"]]
    run[2] = run[2].replace("exec cloudrc", "echo")
    said = [
        subprocess.run(run, env={"JOB_COMPLETION_INDEX": str(n)}, capture_output=True, text=True)
        for n in (0, 3)
    ]
    wanted = "sweep rows /flights/flights.json.gz --shard={}/4\n"
    assert [each.stdout for each in said] == [wanted.format(1), wanted.format(4)]
    batch.start(release, "sweep-2", b"flights", PODS._replace(image=None, queue="lab"))
    queued = api.get("jobs", "sweep-2")
    (container,) = queued["spec"]["template"]["spec"]["containers"]
    assert container["image"] == f"cloudrc/world:{__version__}", "the image of the chart's example"
    assert queued["metadata"]["labels"]["kueue.x-k8s.io/queue-name"] == "lab"
    pods = queued["spec"]["template"]["metadata"]["labels"]
    assert "kueue.x-k8s.io/queue-name" not in pods, "the queue takes the whole Job"


def test_a_running_job_is_kept_and_a_failed_job_is_replaced(started, api, release):
    first = api.get("jobs", "sweep-1")["metadata"]["uid"]
    batch.start(release, "sweep-1", b"flights", PODS)
    assert api.get("jobs", "sweep-1")["metadata"]["uid"] == first
    api.end("sweep-1", "Failed", reason="FailedIndexes", message="two")
    batch.start(release, "sweep-1", b"flights", PODS)
    assert api.get("jobs", "sweep-1")["metadata"]["uid"] != first


def test_the_lines_of_lost_and_complete_pods_are_read(started, api, release):
    add_pod(api, "a", "Running", "row 1\n")
    for name, log in (("b", "row 2\n"), ("d", ""), ("e", "")):
        add_pod(api, name, "Failed", log, state=terminated(137, ""))
    api.logs["e"] = None  # refused

    def replace():
        api.objects.pop(("pods", "a"))
        add_pod(api, "c", "Succeeded", "row 1\nrow 3\n")
        api.end("sweep-1", "Complete")

    api.at_look(3, replace)
    found, told = lines(release)
    assert {*found} == {"row 1", "row 2", "row 3"}
    assert found.count("row 2") == 1
    end, log = told
    assert "exit code 137" in end, "once, although three pods ended so"
    assert "cannot get pods/log" in log
    assert api.jobs() == []


def test_the_first_pod_that_refuses_the_flights_ends_the_job(started, api, release):
    """For example, the image has other code: no shard of the Job can succeed."""
    said = "the flights come from code 1, this image has code 2"
    for name in ("a", "b"):
        add_pod(api, name, "Failed", "a log", state=terminated(2, said))
    with pytest.raises(BadInputError, match=f"^the pods refuse the flights: {said}$"):
        lines(release)
    assert api.jobs() == []
