"""The pods satisfy Pod Security "restricted", except a link with netem."""

import pytest

from tests.chart.conftest import (
    a_namespace,
    containers,
    each_file,
    of_kind,
    pod_specs,
    render,
    values_of,
)

VOLUMES = {"configMap", "emptyDir", "secret", "persistentVolumeClaim"}


def breaches(pod):
    """List the violations of Pod Security "restricted": container and reason."""
    found = [f"pod: {key}" for key in ("hostNetwork", "hostPID", "hostIPC") if pod.get(key)]
    for volume in pod.get("volumes", ()):
        if not VOLUMES & volume.keys():
            found.append(f"pod: volume {volume['name']}")
    for name, container in containers(pod).items():
        own = container["securityContext"]
        merged = {**pod["securityContext"], **own}
        if merged.get("runAsNonRoot") is not True or merged.get("runAsUser", 0) == 0:
            found.append(f"{name}: root")
        if merged.get("seccompProfile") != {"type": "RuntimeDefault"}:
            found.append(f"{name}: seccomp")
        if own.get("allowPrivilegeEscalation") is not False or own.get("privileged"):
            found.append(f"{name}: escalation")
        if own["capabilities"].get("drop") != ["ALL"] or own["capabilities"].get("add"):
            found.append(f"{name}: capabilities")
    return found


@each_file
def test_a_release_passes_restricted_with_the_relay(path):
    values = values_of(path)
    values["link"] = {**values.get("link", {}), "mode": "relay"}
    objects = render(values)
    pods = pod_specs(objects)
    assert {"world", "cloud", "test", "test-link"} <= pods.keys()
    for pod in pods.values():
        assert breaches(pod) == []
        assert pod["automountServiceAccountToken"] is False
        assert pod["enableServiceLinks"] is False
        for key in ("runAsUser", "runAsGroup", "fsGroup"):
            assert pod["securityContext"][key] >= 10_000, "not an id of the node"
        for container in containers(pod).values():
            assert container["securityContext"]["readOnlyRootFilesystem"] is True
            for part in ("requests", "limits"):
                assert container["resources"][part].keys() == {"cpu", "memory"}
    for account in of_kind(objects, "ServiceAccount").values():
        assert account["automountServiceAccountToken"] is False
    kinds = {thing["kind"] for thing in objects}
    assert not kinds & {"Role", "RoleBinding", "ClusterRole", "PodDisruptionBudget"}
    for deployment in of_kind(objects, "Deployment").values():
        assert deployment["spec"]["replicas"] == 1
        assert deployment["spec"]["strategy"] == {"type": "Recreate"}


@pytest.mark.parametrize("mode", ["netem", "auto"])
def test_netem_adds_one_capability_to_one_container(mode):
    assert not any(map(breaches, pod_specs(render()).values())), "the namespace is unknown"
    pods = pod_specs(render({"link": {"mode": mode}}, lookup=a_namespace()))
    expected = ["link: root", "link: capabilities"]
    found = {name: breaches(pod) for name, pod in pods.items()}
    assert found == {"world": expected, "cloud": expected, "test": [], "test-link": []}
    link = containers(pods["world"])["link"]["securityContext"]
    assert link["capabilities"] == {"drop": ["ALL"], "add": ["NET_ADMIN"]}
    assert link["runAsUser"] == 0


def test_security_contexts_can_be_left_out_or_changed():
    """OpenShift gives each namespace its own user ids and refuses others."""
    values = {"podSecurityContext": None, "containerSecurityContext": None}
    objects = render({**values, "cloud": {"backgroundLoad": {"enabled": True}}})
    assert "securityContext" not in str(pod_specs(objects))
    for pod in pod_specs(render({"podSecurityContext": {"runAsUser": 12_345}})).values():
        assert pod["securityContext"]["runAsUser"] == 12_345
        assert pod["securityContext"]["runAsNonRoot"] is True


def test_service_accounts_are_made_or_named():
    def accounts(values=None):
        objects = render(values)
        made = {thing["metadata"]["name"] for thing in of_kind(objects, "ServiceAccount").values()}
        return made, {pod["serviceAccountName"] for pod in pod_specs(objects).values()}

    made, used = accounts()
    assert made == used
    named = {"serviceAccount": {"create": False, "name": "robots"}}
    assert accounts(named) == (set(), {"robots"})


def test_probes_use_the_metrics_port_and_liveness_needs_no_peer():
    asked = {"startupProbe": "/healthz", "livenessProbe": "/healthz", "readinessProbe": "/readyz"}
    for thing in of_kind(render(), "Deployment").values():
        for part in containers(thing["spec"]["template"]["spec"]).values():
            gets = {probe: part[probe]["httpGet"] for probe in asked}
            assert {probe: get["path"] for probe, get in gets.items()} == asked
            (port,) = {get["port"] for get in gets.values()}
            assert port.endswith("metrics")
            assert port in {each["name"] for each in part["ports"]}
