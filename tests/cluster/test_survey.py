# SPDX-License-Identifier: Apache-2.0

"""`cloudrc doctor --cluster` says what would stop an install, and leaves nothing behind."""

import pytest

from cloudrc.cluster import survey
from tests.cluster.conftest import pod, terminated, waiting

CHART = """\
apiVersion: apps/v1
kind: Deployment
metadata: {name: x, labels: {app.kubernetes.io/component: COMPONENT}}
spec:
  replicas: REPLICAS
  template:
    spec:
      serviceAccountName: made-by-the-chart
      initContainers: [{name: link, image: i, resources: {requests: {cpu: 20m}}}]
      containers: [{name: COMPONENT, image: i, resources: {requests: {cpu: 60m}}}]
      volumes:
      - {name: data, persistentVolumeClaim: {claimName: CLAIM}}
      - {name: secret, secret: {secretName: of-the-chart}}
---
"""
FILES = """\
apiVersion: v1
kind: ConfigMap
metadata: {name: files}
data:
  experiment.yaml: "{cloud: {predictor: PREDICTOR}, camera: PICTURES}"
  profile.yaml: "profile: null"
---
apiVersion: v1
kind: Secret
metadata: {name: of-the-chart}
---
apiVersion: v1
kind: PersistentVolumeClaim
metadata: {name: journal}
spec: {storageClassName: CLASS}
---
"""
SETTINGS = {"CLAIM": "journal", "PREDICTOR": "kalman", "CLASS": "gold", "PICTURES": "null"}
SECURITY = 'pods "x" is forbidden: violates PodSecurity "restricted:latest"'


@pytest.fixture
def cluster(api, pretend, monkeypatch):
    """The fake API server, on which pods of the survey run and end."""
    pretend_chart(pretend)
    api.put("storageclasses", {"metadata": {"name": "gold"}, "provisioner": "x"})
    monkeypatch.setattr(survey, "LOOK_PERIOD", 0.01)
    put = api.put
    api.ended = {"phase": "Succeeded"}

    def run_at_once(plural, body):
        made = put(plural, body)
        if plural == "pods":
            made["status"] = api.ended
        return made

    monkeypatch.setattr(api, "put", run_at_once)
    return api


def pretend_chart(pretend, robots=1, **settings):
    """Let `helm` render a chart whose world and cloud have a pod for each robot."""
    chart = CHART.replace("REPLICAS", str(robots))
    rendered = FILES + "".join(chart.replace("COMPONENT", each) for each in ("world", "cloud"))
    for name, value in (SETTINGS | settings).items():
        rendered = rendered.replace(name, value)
    pretend("helm", f"cat <<'END'\n{rendered}END")


def found(release):
    return {one.name: one for one in survey.survey(release)}


def test_a_cluster_that_is_fit_has_no_problem_and_keeps_no_pod(cluster, release):
    cluster.put("nodes", {"metadata": {"name": "two"}, "spec": {}})
    seen = found(release)
    checks = ["permissions", "experiment", "StorageClass", "world pod", "cloud pod"]
    checks += ["node one", "node two"]
    assert list(seen) == checks
    assert [one for one in seen.values() if one.state != "ok"] == []
    assert seen["node two"].found == "has the images"
    assert not [name for kind, name in cluster.objects if kind == "pods"]


@pytest.mark.parametrize("camera", [False, True])
def test_a_node_tells_how_fast_it_draws_if_there_is_a_camera(
    cluster, release, pretend, monkeypatch, camera
):
    pretend_chart(pretend, PICTURES="{}" if camera else "null")
    cluster.put("nodes", {"metadata": {"name": "one"}, "spec": {}})
    ended, commands = terminated(0, "3 ms for a picture" * camera), []
    cluster.ended = pod("one", "world", state=ended, phase="Succeeded")["status"]
    put = cluster.put
    monkeypatch.setattr(cluster, "put", lambda *given: commands.append(given[1]) or put(*given))
    assert found(release)["node one"].found == "has the images" + "; 3 ms for a picture" * camera
    assert ("doctor import draw" in str(commands)) is camera


def test_a_node_without_an_image_is_told(cluster, release):
    waits = waiting("ErrImagePull", "no such image")
    cluster.ended = pod("one", "world", state=waits, ready=False, phase="Pending")["status"]
    seen = found(release)["node one"]
    assert seen.state == "missing"
    assert "the image cloudrc/cloud:0.1.0 of container 'world' is not on the node" in seen.found


def test_missing_permissions_end_the_survey(cluster, release):
    cluster.forbidden = {"secrets", "events"}
    (only,) = found(release).values()
    assert only.state == "missing"
    assert "create secrets, patch secrets, delete secrets" in only.found
    assert "list events" in only.found
    assert "pods" not in only.found


def test_pod_security_leads_to_the_relay(cluster, release):
    cluster.refuse["POST", "pods"] = (403, SECURITY)
    assert "link.mode=relay" in found(release)["cloud pod"].fix


@pytest.mark.parametrize(("robots", "less", "enough"), [(1, "150m", "160m"), (3, "470m", "480m")])
def test_a_quota_is_compared_with_all_pods_together(
    robots, less, enough, cluster, release, pretend
):
    pretend_chart(pretend, robots)
    status = {"hard": {"requests.cpu": less}, "used": {"requests.cpu": "0"}}
    cluster.put("resourcequotas", {"metadata": {"name": "small"}, "status": status})
    seen = found(release)["quota small"]
    assert seen.state == "missing"
    assert f"needs {enough} requests.cpu: 0 of {less} are used" in seen.found
    status["hard"]["requests.cpu"] = enough
    assert found(release)["quota small"].state == "ok"


@pytest.mark.parametrize(
    ("settings", "name", "words"),
    [
        ({"CLAIM": "nothere"}, "PersistentVolumeClaim nothere", "recordings.existingClaim"),
        ({"PREDICTOR": "nope"}, "experiment", "cloud.predictor: no predictor named 'nope'"),
        ({"CLASS": "tin"}, "StorageClass", "no StorageClass 'tin'; there are: gold"),
    ],
)
def test_values_that_cannot_run_are_told_with_their_remedy(
    cluster, release, pretend, settings, name, words
):
    pretend_chart(pretend, **settings)
    seen = found(release)[name]
    assert seen.state == "missing"
    assert words in f"{seen.found}; {seen.fix}"
    cluster.put("persistentvolumeclaims", {"metadata": {"name": "nothere"}, "spec": {}})
    cluster.put("storageclasses", {"metadata": {"name": "tin"}, "provisioner": "x"})
    assert (found(release)[name].state == "ok") == ("PREDICTOR" not in settings)


def test_a_dns_without_pods_is_told_unless_a_policy_may_refuse_the_probe(cluster, release):
    message = "kubernetes.default.svc: Temporary failure in name resolution"
    ended = pod("one", "cloud", state=terminated(1, message), phase="Failed")
    cluster.ended = ended["status"]
    seen = found(release)["node one"]
    assert (seen.state, "k8s-app=kube-dns" in seen.fix) == ("missing", True)
    assert message in seen.found
    cluster.put("networkpolicies", {"metadata": {"name": "deny"}})
    assert found(release)["node one"].state == "warn"
