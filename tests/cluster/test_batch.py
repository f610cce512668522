# SPDX-License-Identifier: Apache-2.0

"""The Job of a sweep is created once, its log is read, and its failures are named."""

import base64
import itertools
import subprocess

import pytest

from cloudrc import __version__
from cloudrc.base.errors import BadInputError
from cloudrc.cluster import batch, client
from cloudrc.cluster.batch import PodSettings
from cloudrc.cluster.client import ClusterError
from cloudrc.cluster.jobs import UID_LABEL
from cloudrc.config.load import load_experiment
from tests.cluster.conftest import pod, terminated
from tests.conftest import nightly

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
    assert "--out" not in str(container)
    batch.start(release, "sweep-2", b"flights", PODS._replace(image=None, queue="lab"))
    queued = api.get("jobs", "sweep-2")
    (container,) = queued["spec"]["template"]["spec"]["containers"]
    assert container["image"] == f"cloudrc/world:{__version__}", "the image of the chart's example"
    assert queued["metadata"]["labels"]["kueue.x-k8s.io/queue-name"] == "lab"
    pods = queued["spec"]["template"]["metadata"]["labels"]
    assert "kueue.x-k8s.io/queue-name" not in pods, "the queue takes the whole Job"


def test_flights_with_a_camera_get_the_image_that_draws():
    follow = load_experiment("follow")
    assert batch.image_for([load_experiment("gap")]) is None
    assert batch.image_for([follow]) == f"cloudrc/world-camera:{__version__}"
    with pytest.raises(BadInputError, match="h264 needs PyAV"):
        batch.image_for([follow, load_experiment("follow", ["camera.codec=h264"])])


def test_the_flags_of_the_job_reach_it(api, release, tmp_path):
    (tmp_path / "p.py").write_text("# mine")
    changes = {("nodeSelector", "disk"): "ssd", ("ttlSecondsAfterFinished",): 60, ("env",): []}
    changes |= {("resources", "limits", "gpu"): "1", ("securityContext", "privileged"): False}
    changes |= {("securityContext", "fsGroup"): 7, ("restartPolicy",): "OnFailure"}
    asked = {"parallelism": 2, "cpu_limit": "2", "memory": "1Gi", "claim": "rows"}
    pods = PODS._replace(**asked, changes=changes)
    batch.start(release, "sweep-1", b"flights", pods, [str(tmp_path / "p.py")])
    spec, data = api.get("jobs", "sweep-1")["spec"], api.get("configmaps", "sweep-1")
    assert (spec["parallelism"], spec["ttlSecondsAfterFinished"]) == (2, 60)
    pod = spec["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["nodeSelector"] == {"disk": "ssd"}
    assert container["env"] == []
    assert container["args"] == ["4", "--out=/rows/sweep-1"]
    assert container["resources"]["limits"] == {"cpu": "2", "memory": "1Gi", "gpu": "1"}
    assert container["securityContext"]["privileged"] is False
    assert (pod["securityContext"]["fsGroup"], pod["restartPolicy"]) == (7, "OnFailure")
    assert {"name": "rows", "mountPath": "/rows"} in container["volumeMounts"]
    assert pod["volumes"][-1]["persistentVolumeClaim"] == {"claimName": "rows"}
    own = container["volumeMounts"][-1]
    assert own["mountPath"] == str(tmp_path / "p.py"), "as on this machine: the path is in the key"
    assert base64.b64decode(data["binaryData"][own["subPath"]]) == b"# mine"
    batch.start(release, "sweep-2", b"", PODS._replace(bucket="s3://lab/x/"))
    (container,) = api.get("jobs", "sweep-2")["spec"]["template"]["spec"]["containers"]
    assert container["args"] == ["4", "--out=s3://lab/x/sweep-2"]
    assert "did you mean tolera" in batch.unknown_field([("toleration", "x")])
    assert batch.unknown_field([("securityContext", "root")]).startswith("securityContext.root: ")
    assert not batch.unknown_field([("securityContext", "runAsUser")])


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
        api.drop("pods", "a")
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
    with pytest.raises(BadInputError, match=f"^the pods reject the flights: {said}$"):
        lines(release)
    assert api.jobs() == []


@pytest.mark.parametrize("pods", [100, *nightly(1000)])
def test_a_minute_takes_few_requests_even_if_all_pods_end_in_it(started, api, release, pods):
    """A look is once a second; before, it read the log of each pod: 60,000 requests."""
    looks = itertools.count(1)

    def end_some(path):
        if "/jobs" not in path:
            return
        look = next(looks)
        for number in range(pods * (look - 1) // 60, pods * look // 60):
            add_pod(api, f"pod-{number}", "Succeeded", f"row {number}\n", state=terminated(0, ""))
        if look == 60:
            api.end("sweep-1", "Complete")

    for number in range(pods):
        add_pod(api, f"pod-{number}", "Running")
    before = len(api.seen)
    api.hooks.append(end_some)
    found = [*batch.JobReader(release, "sweep-1", print, lambda pod, state: "").read()]
    assert {*found} == {f"row {number}" for number in range(pods)}
    assert len(found) == pods
    assert len(api.seen) - before <= pods + 200


def test_running_pods_are_read_in_turn_and_a_forgotten_watch_begins_again(started, api, release):
    """So a client sees progress; and it follows a Job for days."""
    for name in ("a", "b"):
        add_pod(api, name, "Running", f"row {name}\n")

    def forget():
        add_pod(api, "c", "Succeeded", "row c\n", state=terminated(0, ""))
        api.forgotten = len(api.changes)

    def end():
        assert "row c" in found
        api.end("sweep-1", "Complete")

    found = []
    api.at_look(4, forget)
    api.at_look(8, end)
    for line in batch.JobReader(release, "sweep-1", print, lambda pod, state: "").read():
        found.append(line)
    assert found == ["row a", "row b", "row c"]


def test_a_claim_that_does_not_exist_ends_the_sweep(started, api, release):
    """A pod that waits for a node may get one; nobody makes the claim."""
    said = '0/1 nodes are available: persistentvolumeclaim "rows" not found. not found'
    waits = [{"type": "PodScheduled", "status": "False", "message": said}]
    add_pod(api, "a", "Pending", conditions=waits, ready=False)
    with pytest.raises(ClusterError, match=r'cannot start: .*claim "rows" not found'):
        lines(release)


def test_a_field_that_kubernetes_does_not_know_is_named(release):
    pods = PODS._replace(changes={("tolerations",): [{"kee": "x"}]})
    with pytest.raises(ClusterError, match=r"spec.template.spec.tolerations.0.kee Extra inputs"):
        batch.start(release, "sweep-1", b"flights", pods)


def test_a_server_that_does_not_answer_for_a_while_ends_no_sweep(
    started, api, release, monkeypatch
):
    """Neither `sweep run` nor `sweep attach`: both read the Job's lines."""
    monkeypatch.setattr(client, "RETRIES", {**client.RETRIES, "total": 0, "backoff_factor": 0.0})
    monkeypatch.setattr(client, "PAUSE", 0.0)
    add_pod(api, "a", "Succeeded", "row 1\n", state=terminated(0, ""))
    api.end("sweep-1", "Complete")
    told = []
    for plural, code in (("jobs", 503), ("pods", 500)):
        left = api.away(plural, code, 3)
        found = [*batch.JobReader(release, "sweep-1", told.append, lambda pod, state: "").read()]
        assert (found, left) == (["row 1"], [])
        assert len(told) == 1, "the error is told once"
        assert "leader changed; trying again for 60 s" in told.pop()
    monkeypatch.setattr(client, "PATIENCE", -1.0)
    api.away("jobs", 503, 3)
    with pytest.raises(ClusterError, match=r"leader changed; Job 'sweep-1' goes on without"):
        lines(release)


@pytest.mark.parametrize(
    ("message", "remedy", "other"),
    [
        ("exceeded quota: small, requested: pods=4", "--shards", "--set-job"),
        ('violates PodSecurity "restricted"', "--set-job", "--cpu"),
        ("serviceaccount not found", "delete the Job", "--cpu"),
    ],
)
def test_the_remedy_of_a_sweep_fits_its_cause(started, api, release, message, remedy, other):
    api.tell_of("jobs", "sweep-1", reason="FailedCreate", message=message)
    with pytest.raises(ClusterError) as told:
        lines(release)
    assert remedy in str(told.value)
    assert other not in str(told.value)
