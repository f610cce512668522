# SPDX-License-Identifier: Apache-2.0

"""What a release suffers from is found in what its cluster and its pods returned."""

import re

import pytest

from cloudrc.base.outside.prometheus import read_metrics
from cloudrc.cluster import incidents
from cloudrc.cluster.diagnosis import diagnose, is_suspicious
from cloudrc.cluster.incidents import find_causes, observe
from tests.cluster.conftest import OUT_OF_MEMORY, deployment, pod, terminated, waiting

SENT = 'cloudrc_datagrams_total{direction="%s",outcome="sent"}'
USED = 'cloudrc_datagrams_total{direction="%s",outcome="used"}'
TAG = 'cloudrc_datagrams_total{direction="downlink",outcome="tag"}'
RELAYED = 'cloudrc_link_datagrams_total{outcome="forwarded"}'
PERIODS, STOPPED = "cloudrc_cpu_periods_total", "cloudrc_cpu_throttled_periods_total"


def pages(world=None, cloud=None, link=None):
    """Build the metrics of a robot whose two ends hear each other, with changes."""
    ways = {"world": ("uplink", "downlink"), "cloud": ("downlink", "uplink")}
    ends = {
        end: {"cloudrc_ready": 1.0, SENT % sends: 200.0, USED % hears: 200.0, PERIODS: 25.0}
        for end, (sends, hears) in ways.items()
    }
    shown = {
        ("world", "world"): ends["world"] | (world or {}),
        ("cloud", "cloud"): ends["cloud"] | (cloud or {}),
        ("cloud", "link"): {RELAYED: 200.0, "cloudrc_dns_errors_total": 0.0} | (link or {}),
    }
    return {
        place: read_metrics("".join(f"{series} {value}\n" for series, value in page.items()))
        for place, page in shown.items()
    }


def unready(name, component, **given):
    return pod(name, component, ready=False, **given)


def unscheduled(message):
    return [{"type": "PodScheduled", "status": "False", "message": message}]


def denied(message):
    told = {"type": "ReplicaFailure", "status": "True", "message": message}
    return deployment("cloud", conditions=[told])


NO_CLAIM = '0/1 nodes are available: persistentvolumeclaim "nothere" not found. no preemption'
QUOTA = 'pods "x" is forbidden: exceeded quota: tiny, requested: requests.cpu=30m'
CRASHES = {"state": waiting("CrashLoopBackOff"), "last": OUT_OF_MEMORY}
DEAF = {USED % "downlink": 0.0, "cloudrc_ready": 0.0}


@pytest.mark.parametrize(
    ("plural", "body", "words"),
    [
        (
            "pods",
            unready("cloud-1", "cloud", phase="Pending", state=waiting("ImagePullBackOff")),
            "the image cloudrc/cloud:0.1.0 .*; name one .*make kind-load",
        ),
        ("deployments", denied(QUOTA), "exceeded quota: tiny.*; ask for a larger quota"),
        (
            "pods",
            unready("cloud-1", "cloud", phase="Pending", conditions=unscheduled(NO_CLAIM)),
            '"nothere" not found.*; make the claim.*recordings.existingClaim',
        ),
        (
            "pods",
            unready("cloud-1", "cloud", phase="Pending", conditions=unscheduled("1 full; 2 gone")),
            "cannot run: no node takes it: 1 full; 2 gone; see: kubectl .* describe pods",
        ),
        (
            "pods",
            unready("cloud-1", "cloud", **CRASHES),
            "was killed, because .*; helm upgrade .*cloud.resources.limits.memory=SIZE",
        ),
        (
            "pods",
            unready("cloud-1", "cloud", last=terminated(3, "port 9100 is taken"), restarts=1),
            "exit code 3: port 9100 is taken; see: kubectl .* logs cloud-1 -c cloud --previous",
        ),
    ],
)
def test_a_pod_that_does_not_run_is_named_with_its_remedy(running, release, plural, body, words):
    running.put(plural, body)
    if plural == "deployments":
        running.drop("pods", "cloud-1")
    (one,) = diagnose(release, observe(release))
    assert (one.name, one.state) == ("cloud pod", "missing")
    assert re.search(words, str(one)), str(one)


@pytest.mark.parametrize(
    ("after", "name", "words"),
    [
        (
            pages(world=DEAF),
            "network",
            "UDP from the cloud pod does not arrive at the world pod.*get networkpolicies",
        ),
        (
            pages(world={TAG: 9.0, **DEAF}),
            "key",
            "the world pod rejects .* another key; .* rollout restart "
            "deployment/cloudrc-world deployment/cloudrc-cloud",
        ),
        (
            pages(cloud={STOPPED: 20.0}),
            "cloud CPU",
            "'cloud' .* in 80% of the time slices; raise cloud.resources.limits.cpu: helm",
        ),
    ],
)
def test_what_the_metrics_tell_is_named_with_its_remedy(running, release, after, name, words):
    running.put("pods", unready("world-1", "world"))  # which follows from the cause
    (one,) = diagnose(release, observe(release), [({}, after)])
    assert one.name == name
    assert re.search(words, str(one)), str(one)
    assert is_suspicious(after)
    still = diagnose(release, observe(release), [(after, after)])
    assert name not in [one.name for one in still], "counters that stand tell of the past"


def test_two_secrets_with_a_key_are_named(running, release):
    for end in ("world", "cloud"):
        body = deployment(end)
        volumes = [{"name": "secret", "secret": {"secretName": f"of-{end}"}}]
        body["spec"]["template"] = {"spec": {"containers": [{"name": end}], "volumes": volumes}}
        running.put("deployments", body)
    (one,) = diagnose(release, observe(release), [({}, pages(world={TAG: 9.0, **DEAF}))])
    assert "(world 'of-world', cloud 'of-cloud')" in one.fix
    assert "secret.existingSecret=NAME" in one.fix


def test_a_name_that_is_not_resolved_is_the_cause_of_silence(running, release):
    (one,) = diagnose(release, observe(release), [({}, pages(world=DEAF))], ["pod cloud-1"])
    assert (one.name, one.state) == ("DNS", "missing")
    assert "k8s-app=kube-dns" in one.fix


def test_a_relay_that_loses_everything_is_no_fault_of_the_network(running, release):
    assert diagnose(release, observe(release), [({}, pages(world=DEAF, link={RELAYED: 0.0}))]) == []


def test_a_pod_that_starts_is_told_and_a_healthy_release_has_no_cause(running, release):
    assert diagnose(release, observe(release), [({}, pages())]) == []
    assert diagnose(release, observe(release), [({}, pages(world={TAG: 9.0}))]) == [], "forged"
    assert not is_suspicious(pages())
    running.put("pods", unready("cloud-1", "cloud"))
    (one,) = diagnose(release, observe(release))
    assert one.found == "the cloud pod waits: container cloud is not ready yet"


def test_a_claim_without_a_storage_class_is_told(running, release):
    body = unready("cloud-1", "cloud", phase="Pending")
    del body["status"]["containerStatuses"]
    claim = {"name": "data", "persistentVolumeClaim": {"claimName": "mine"}}
    body["spec"] = {**body["spec"], "volumes": [claim]}
    running.put("pods", body)
    running.put("persistentvolumeclaims", {"metadata": {"name": "mine"}})
    message = 'storageclass.storage.k8s.io "gold" not found'
    running.tell_of("persistentvolumeclaims", "mine", reason="ProvisioningFailed", message=message)
    (one,) = find_causes(release)
    assert "claim 'mine' gets no volume" in one.found
    assert "kubectl get storageclasses" in one.fix


METRICS = [{"name": "metrics", "containerPort": 9100}, {"name": "tunnel", "containerPort": 7400}]
LOOKS_UP = """case "$*" in
*port-forward*) echo "Forwarding from 127.0.0.1:1 -> 8080"; exec sleep 60;;
*exec*) echo "cloudrc-world: no name" >&2; exit 1;;
esac"""


@pytest.fixture
def measured(running, monkeypatch, pretend):
    """A release whose containers serve metrics: each look takes the next ones."""
    for end in ("world", "cloud"):
        body = pod(f"{end}-1", end)
        body["status"]["containerStatuses"][0]["started"] = True
        link = {"name": "link", "args": ["--peer=cloudrc-world:7400"], "ports": METRICS}
        own = {"name": end, "ports": METRICS}
        body["spec"] = {**body["spec"], "containers": [own], "initContainers": [link]}
        more = [{**body["status"]["containerStatuses"][0], "name": "link"}]
        body["status"]["initContainerStatuses"] = more
        running.put("pods", body)
    told = {"world-1": "cloudrc_ready 1\n", "cloud-1": "cloudrc_ready 1\n"}
    monkeypatch.setattr(incidents, "WINDOW", 0.0)
    monkeypatch.setattr(incidents, "read_page", lambda release, pod, port: told[pod])
    pretend("kubectl", LOOKS_UP)
    return told


def test_doctor_looks_at_a_release(measured, call):
    report = "doctor --release cloudrc"
    assert call(report).out.splitlines()[-1] == "Release cloudrc: nothing to solve."
    measured["cloud-1"] += "cloudrc_dns_errors_total 3\n"
    said = call(report, code=3).out
    assert "the link of pod cloud-1 cannot resolve" in said
    assert said.splitlines()[-1] == "Release cloudrc: 1 thing to solve."
    assert "no release 'other'" in call("doctor --release other", code=3).out


def test_the_state_of_a_pod_stands_in_place_of_a_port_that_does_not_answer(running, refused):
    running.put("pods", unready("cloud-1", "cloud", phase="Pending"))
    said = refused("mission status", code=5)
    assert "error: the cloud pod waits: container cloud is not ready yet; see: kubectl" in said
