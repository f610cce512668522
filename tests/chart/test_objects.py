"""Names, labels, selectors, images and arguments fit together."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import cloudrc
from tests.chart.conftest import (
    CHART,
    CI_VALUES,
    METADATA,
    containers,
    of_kind,
    pod_specs,
    render,
    values_of,
)

LABELS = {f"app.kubernetes.io/{key}" for key in (
    "name", "instance", "version", "component", "part-of", "managed-by",
)} | {"helm.sh/chart"}  # fmt: skip
SELECTORS = {f"app.kubernetes.io/{key}" for key in ("name", "instance", "component")}


def test_the_chart_has_the_version_of_the_package() -> None:
    assert METADATA["version"] == METADATA["appVersion"] == cloudrc.__version__


@pytest.mark.parametrize("path", CI_VALUES, ids=lambda path: path.stem)
def test_objects_have_the_labels_that_selectors_need(path: Path) -> None:
    objects = render(values_of(path))
    for thing in objects:
        assert thing["metadata"]["labels"].keys() >= LABELS, thing["metadata"]["name"]
    pods = [
        thing["spec"]["template"]["metadata"]["labels"]
        for thing in objects
        if thing["kind"] == "Deployment"
    ]
    for thing in objects:
        spec = thing.get("spec", {})
        if thing["kind"] in ("Service", "Deployment"):
            selector = spec["selector"].get("matchLabels", spec["selector"])
            assert selector.keys() == SELECTORS
            assert sum(selector.items() <= labels.items() for labels in pods) == 1


def test_a_new_chart_version_alone_restarts_no_pod() -> None:
    for thing in of_kind(render(), "Deployment").values():
        labels = thing["spec"]["template"]["metadata"]["labels"]
        assert not labels.keys() & {"helm.sh/chart", "app.kubernetes.io/version"}


@pytest.mark.parametrize(
    ("release", "values", "name"),
    [
        ("demo", {}, "demo-cloudrc-world"),
        ("cloudrc", {}, "cloudrc-world"),
        ("my-cloudrc", {}, "my-cloudrc-world"),
        ("demo", {"fullnameOverride": "robot"}, "robot-world"),
        ("d" * 53, {}, "d" * 46 + "-world"),
    ],
)
def test_names_follow_release_and_override(release: str, values: dict[str, str], name: str) -> None:
    objects = render({**values, "mission": {"enabled": True}}, release=release)
    assert name in {thing["metadata"]["name"] for thing in objects}
    assert max(len(thing["metadata"]["name"]) for thing in objects) <= 63


@pytest.mark.parametrize("release", ["1rel", "my.rel"])
def test_an_invalid_name_is_refused(release: str) -> None:
    with pytest.raises(Exception, match=f"the name '{release}-cloudrc' .* set fullnameOverride"):
        render(release=release)
    assert render({"fullnameOverride": "robot"}, release=release)


def test_annotations_of_the_user_override_the_charts() -> None:
    mine = {"prometheus.io/scrape": "false", "example.org/owner": "me"}
    pods = of_kind(render({"cloud": {"podAnnotations": mine}}), "Deployment")
    found = pods["cloud"]["spec"]["template"]["metadata"]["annotations"]
    assert mine.items() <= found.items()
    assert found["prometheus.io/port"] == "9100"


def test_missions_have_the_placement_of_cloud() -> None:
    where = {
        "nodeSelector": {"disk": "fast"},
        "tolerations": [{"key": "lab", "operator": "Exists"}],
        "affinity": {"nodeAffinity": {}},
    }
    pods = pod_specs(render({"cloud": where, "mission": {"enabled": True}}))
    for name in ("cloud", "mission", "test", "test-link"):
        assert where.items() <= pods[name].items()
    assert not where.keys() & pods["world"].keys()


def images(values: dict[str, object]) -> dict[str, str]:
    pods = pod_specs(render({"image": values}))
    return {
        name: container["image"]
        for pod in pods.values()
        for name, container in containers(pod).items()
    }


def test_the_image_is_the_one_from_make_images() -> None:
    assert images({})["world"] == f"cloudrc/world:{cloudrc.__version__}"
    for name in ("teleop", "test", "test-link"):
        assert images({})[name] == f"cloudrc/cloud:{cloudrc.__version__}"
    assert {
        c["imagePullPolicy"] for p in pod_specs(render()).values() for c in containers(p).values()
    } == {"IfNotPresent"}


def test_a_digest_overrides_the_tag_and_a_tag_the_version() -> None:
    digest = "sha256:" + "0" * 64
    found = images({"registry": "ghcr.io/me", "tag": "9.9.9", "world": {"digest": digest}})
    assert found["world"] == f"ghcr.io/me/cloudrc/world@{digest}"
    assert found["cloud"] == "ghcr.io/me/cloudrc/cloud:9.9.9"


def test_each_pod_has_one_image() -> None:
    """A node pulls one image per pod, because the link uses that of its pod."""
    for pod in pod_specs(render()).values():
        assert len({container["image"] for container in containers(pod).values()}) == 1


def test_the_tunnels_services_are_headless_and_early() -> None:
    services = of_kind(render(), "Service")
    for end in ("world", "cloud"):
        spec = services[end]["spec"]
        assert spec["clusterIP"] == "None"
        assert spec["publishNotReadyAddresses"] is True
        assert [(port["port"], port["protocol"]) for port in spec["ports"]] == [(7400, "UDP")]


def test_the_link_is_a_native_sidecar_for_its_pods_egress() -> None:
    pods = pod_specs(render())
    for end, direction, peer in (("world", "uplink", "cloud"), ("cloud", "downlink", "world")):
        (link,) = pods[end]["initContainers"]
        assert link["name"] == "link"
        assert link["restartPolicy"] == "Always"
        assert f"--direction={direction}" in link["args"]
        assert f"--peer=demo-cloudrc-{peer}:7400" in link["args"]
        assert "--end=127.0.0.1:7400" in link["args"]
        (own,) = (c for c in pods[end]["containers"] if c["name"] == end)
        assert "--route=/run/cloudrc/route" in set(link["args"]) & set(own["args"])


def test_cloud_and_teleop_are_two_containers() -> None:
    found = containers(pod_specs(render())["cloud"])
    assert list(found) == ["link", "cloud", "teleop"]
    loaded = {"cloud": {"backgroundLoad": {"enabled": True, "workers": 3}}}
    load = containers(pod_specs(render(loaded))["cloud"])["load"]
    assert "seq 3" in load["command"][-1]


def test_the_link_set_role_may_change_one_configmap() -> None:
    """The experiment's ConfigMap has the guard's limits."""
    role = values_of(CHART / "examples" / "link-set-role.yaml")
    changing = [rule for rule in role["rules"] if set(rule["verbs"]) - {"get", "list", "create"}]
    assert changing == [
        {
            "apiGroups": [""],
            "resources": ["configmaps"],
            "resourceNames": ["cloudrc-link"],
            "verbs": ["get", "patch"],
        }
    ]
    assert "cloudrc-link" in of_kind(render(release="cloudrc"), "ConfigMap")


def test_mounts_have_volumes_and_volumes_have_objects() -> None:
    objects = render()
    names = {(thing["kind"], thing["metadata"]["name"]) for thing in objects}
    kinds = {"configMap": ("ConfigMap", "name"), "secret": ("Secret", "secretName"),
             "persistentVolumeClaim": ("PersistentVolumeClaim", "claimName")}  # fmt: skip
    for pod in pod_specs(objects).values():
        volumes = {volume["name"]: volume for volume in pod.get("volumes", ())}
        mounted = {m["name"] for c in containers(pod).values() for m in c.get("volumeMounts", ())}
        assert mounted == volumes.keys()
        for volume in volumes.values():
            for key, (kind, field) in kinds.items():
                if key in volume:
                    assert (kind, volume[key][field]) in names


def test_no_mount_has_a_sub_path() -> None:
    """A mount with a subPath never gets a changed ConfigMap."""
    for pod in pod_specs(render()).values():
        for container in containers(pod).values():
            assert not any("subPath" in mount for mount in container.get("volumeMounts", ()))


def test_containers_use_valid_arguments() -> None:
    """The parser of the command line accepts every container's arguments."""
    from cloudrc.cli.parser import build_parser

    pods = pod_specs(render({"mission": {"enabled": True, "queue": True}}))
    parsed = 0
    for pod in pods.values():
        for container in containers(pod).values():
            arguments = [re.sub(r"\$\((\w+)\)", r"\1", text) for text in container["args"]]
            options = build_parser([arguments[0]]).parse_args(arguments)
            assert callable(options.execute)
            parsed += 1
    assert parsed == 8
