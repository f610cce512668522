"""Names, labels, selectors, images and flags: the objects fit together, and with the processes."""

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
def test_labels_and_selectors(path: Path) -> None:
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


def test_a_new_chart_version_alone_rolls_no_pod() -> None:
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
def test_names(release: str, values: dict[str, str], name: str) -> None:
    objects = render({**values, "mission": {"enabled": True}}, release=release)
    assert name in {thing["metadata"]["name"] for thing in objects}
    assert max(len(thing["metadata"]["name"]) for thing in objects) <= 63


@pytest.mark.parametrize("release", ["1rel", "my.rel"])
def test_a_release_whose_services_could_have_no_name_is_refused(release: str) -> None:
    with pytest.raises(Exception, match=f"the name '{release}-cloudrc' .* set fullnameOverride"):
        render(release=release)
    assert render({"fullnameOverride": "robot"}, release=release)


def test_what_is_written_on_a_pod_wins_over_the_charts_own() -> None:
    mine = {"prometheus.io/scrape": "false", "example.org/owner": "me"}
    pods = of_kind(render({"cloud": {"podAnnotations": mine}}), "Deployment")
    found = pods["cloud"]["spec"]["template"]["metadata"]["annotations"]
    assert mine.items() <= found.items()
    assert found["prometheus.io/port"] == "9100"


def test_missions_run_where_the_cloud_does() -> None:
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


def test_the_image_is_that_of_make_images() -> None:
    assert images({})["world"] == f"cloudrc/world:{cloudrc.__version__}"
    for name in ("teleop", "test", "test-link"):
        assert images({})[name] == f"cloudrc/cloud:{cloudrc.__version__}"
    assert {
        c["imagePullPolicy"] for p in pod_specs(render()).values() for c in containers(p).values()
    } == {"IfNotPresent"}


def test_a_tag_wins_over_the_version_and_a_digest_over_the_tag() -> None:
    digest = "sha256:" + "0" * 64
    found = images({"registry": "ghcr.io/me", "tag": "9.9.9", "world": {"digest": digest}})
    assert found["world"] == f"ghcr.io/me/cloudrc/world@{digest}"
    assert found["cloud"] == "ghcr.io/me/cloudrc/cloud:9.9.9"


def test_each_pod_has_one_image() -> None:
    """The link of the world pod runs the world's image: one to pull for each node."""
    for pod in pod_specs(render()).values():
        assert len({container["image"] for container in containers(pod).values()}) == 1


def test_the_tunnel_is_pod_to_pod_before_the_pods_are_ready() -> None:
    services = of_kind(render(), "Service")
    for end in ("world", "cloud"):
        spec = services[end]["spec"]
        assert spec["clusterIP"] == "None"
        assert spec["publishNotReadyAddresses"] is True
        assert [(port["port"], port["protocol"]) for port in spec["ports"]] == [(7400, "UDP")]


def test_the_link_is_a_native_sidecar_that_shapes_its_pods_egress() -> None:
    pods = pod_specs(render())
    for end, direction, peer in (("world", "uplink", "cloud"), ("cloud", "downlink", "world")):
        (link,) = pods[end]["initContainers"]
        assert link["name"] == "link"
        assert link["restartPolicy"] == "Always"
        assert f"--direction={direction}" in link["args"]
        assert f"--peer=demo-cloudrc-{peer}:7400" in link["args"]
        (own,) = (c for c in pods[end]["containers"] if c["name"] == end)
        assert "--route=/run/cloudrc/route" in set(link["args"]) & set(own["args"])


def test_cloud_and_teleop_are_two_containers() -> None:
    found = containers(pod_specs(render())["cloud"])
    assert list(found) == ["link", "cloud", "teleop"]
    loaded = {"cloud": {"backgroundLoad": {"enabled": True, "workers": 3}}}
    load = containers(pod_specs(render(loaded))["cloud"])["load"]
    assert "seq 3" in load["command"][-1]


def test_the_role_of_link_set_changes_the_links_config_map_alone() -> None:
    """The experiment's holds the guard's limits."""
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


def test_every_mount_has_its_volume_and_every_volume_its_object() -> None:
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


def test_no_file_is_mounted_alone() -> None:
    """A subPath would never see a changed ConfigMap."""
    for pod in pod_specs(render()).values():
        for container in containers(pod).values():
            assert not any("subPath" in mount for mount in container.get("volumeMounts", ()))


def test_the_flags_are_those_of_the_commands() -> None:
    """Every container's arguments are parsed by the command line that the image runs."""
    from cloudrc.cli.parser import build

    pods = pod_specs(render({"mission": {"enabled": True, "queue": True}}))
    parsed = 0
    for pod in pods.values():
        for container in containers(pod).values():
            arguments = [re.sub(r"\$\((\w+)\)", r"\1", text) for text in container["args"]]
            options = build([arguments[0]]).parse_args(arguments)
            assert callable(options.execute)
            parsed += 1
    assert parsed == 8
