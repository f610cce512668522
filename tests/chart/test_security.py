"""The pods satisfy Pod Security "restricted", except a link with netem."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.chart.conftest import (
    CI_VALUES,
    EXAMPLES,
    Object,
    a_namespace,
    component,
    containers,
    of_kind,
    pod_specs,
    render,
    values_of,
)

FILES = [*CI_VALUES, *EXAMPLES]
each_file = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
VOLUMES = {"configMap", "emptyDir", "secret", "persistentVolumeClaim"}


def breaches(pod: Object) -> list[str]:
    """List the violations of Pod Security "restricted": container and reason."""
    found = []
    shared = pod["securityContext"]
    for key in ("hostNetwork", "hostPID", "hostIPC"):
        if pod.get(key):
            found.append(f"pod: {key}")
    for volume in pod.get("volumes", ()):
        if not VOLUMES & volume.keys():
            found.append(f"pod: volume {volume['name']}")
    for name, container in containers(pod).items():
        own = container["securityContext"]
        merged = {**shared, **own}
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
def test_a_release_passes_restricted_with_the_relay(path: Path) -> None:
    values = {**values_of(path)}
    values["link"] = {**values.get("link", {}), "mode": "relay"}
    pods = pod_specs(render(values))
    assert {"world", "cloud", "test", "test-link"} <= pods.keys()
    assert {name: breaches(pod) for name, pod in pods.items() if breaches(pod)} == {}


def test_security_contexts_can_be_left_out_or_changed() -> None:
    """OpenShift gives each namespace its own user ids and refuses others."""
    values = {"podSecurityContext": None, "containerSecurityContext": None}
    objects = render({**values, "cloud": {"backgroundLoad": {"enabled": True}}})
    for pod in pod_specs(objects).values():
        assert "securityContext" not in pod
        assert not any("securityContext" in part for part in containers(pod).values())
    for pod in pod_specs(render({"podSecurityContext": {"runAsUser": 12_345}})).values():
        assert pod["securityContext"]["runAsUser"] == 12_345
        assert pod["securityContext"]["runAsNonRoot"] is True


def test_missions_and_tests_can_do_without_a_meshs_sidecar() -> None:
    inject = {"sidecar.istio.io/inject": "false"}
    objects = render({"mission": {"enabled": True, "podAnnotations": inject}})
    (job,) = of_kind(objects, "Job").values()
    assert job["spec"]["template"]["metadata"]["annotations"] == inject
    for pod in of_kind(objects, "Pod").values():
        assert pod["metadata"]["annotations"].items() > inject.items()


def test_the_default_is_restricted_if_the_namespace_is_unknown() -> None:
    assert not any(map(breaches, pod_specs(render()).values()))


@pytest.mark.parametrize("mode", ["netem", "auto"])
def test_netem_adds_one_capability_to_one_container(mode: str) -> None:
    pods = pod_specs(render({"link": {"mode": mode}}, lookup=a_namespace()))
    expected = ["link: root", "link: capabilities"]
    assert {name: breaches(pod) for name, pod in pods.items()} == {
        "world": expected,
        "cloud": expected,
        "test": [],
        "test-link": [],
    }
    link = containers(pods["world"])["link"]["securityContext"]
    assert link["capabilities"] == {"drop": ["ALL"], "add": ["NET_ADMIN"]}
    assert link["runAsUser"] == 0


@each_file
def test_root_is_read_only_and_no_account_token_is_mounted(path: Path) -> None:
    objects = render(values_of(path))
    for pod in pod_specs(objects).values():
        assert pod["automountServiceAccountToken"] is False
        assert pod["enableServiceLinks"] is False
        for container in containers(pod).values():
            assert container["securityContext"]["readOnlyRootFilesystem"] is True
    for account in of_kind(objects, "ServiceAccount").values():
        assert account["automountServiceAccountToken"] is False


@each_file
def test_user_ids_are_not_those_of_the_node(path: Path) -> None:
    for pod in pod_specs(render(values_of(path))).values():
        assert pod["securityContext"]["runAsUser"] >= 10_000
        assert pod["securityContext"]["runAsGroup"] >= 10_000
        assert pod["securityContext"]["fsGroup"] >= 10_000


@each_file
def test_every_container_has_requests_and_limits(path: Path) -> None:
    for pod in pod_specs(render(values_of(path))).values():
        for container in containers(pod).values():
            for part in ("requests", "limits"):
                assert container["resources"][part].keys() == {"cpu", "memory"}


def test_a_pod_can_be_guaranteed() -> None:
    same = {"cpu": "500m", "memory": "256Mi"}
    resources = {"resources": {"requests": same, "limits": same}}
    pods = pod_specs(render({"world": resources, "link": resources}))
    for container in containers(pods["world"]).values():
        assert container["resources"]["requests"] == container["resources"]["limits"]


def test_the_chart_has_no_role_and_no_disruption_budget() -> None:
    objects = render()
    kinds = {thing["kind"] for thing in objects}
    assert not kinds & {"Role", "RoleBinding", "ClusterRole", "PodDisruptionBudget"}
    for deployment in of_kind(objects, "Deployment").values():
        assert deployment["spec"]["replicas"] == 1
        assert deployment["spec"]["strategy"] == {"type": "Recreate"}


def test_service_accounts_are_made_or_named() -> None:
    made = render()
    names = {pod["serviceAccountName"] for pod in pod_specs(made).values()}
    assert names == {
        thing["metadata"]["name"] for thing in of_kind(made, "ServiceAccount").values()
    }
    taken = render({"serviceAccount": {"create": False, "name": "robots"}})
    assert not of_kind(taken, "ServiceAccount")
    assert {pod["serviceAccountName"] for pod in pod_specs(taken).values()} == {"robots"}


@each_file
def test_probes_use_the_metrics_port_and_liveness_needs_no_peer(path: Path) -> None:
    for thing in render(values_of(path)):
        if thing["kind"] != "Deployment":
            continue
        for name, container in containers(thing["spec"]["template"]["spec"]).items():
            if name == "load":
                continue
            ports = {port["name"] for port in container["ports"]}
            asked = {"startupProbe": "/healthz", "livenessProbe": "/healthz"}
            for probe, where in {**asked, "readinessProbe": "/readyz"}.items():
                get = container[probe]["httpGet"]
                assert get["path"] == where, (component(thing), name)
                assert get["port"] in ports
                assert get["port"].endswith("metrics")
