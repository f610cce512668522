# SPDX-License-Identifier: Apache-2.0

"""The pods satisfy Pod Security "restricted", except a link with netem."""

from tests.chart.conftest import (
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
    assert {"world", "test"} <= pods.keys()
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
