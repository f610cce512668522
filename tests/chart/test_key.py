"""World and cloud read the key from a file."""

from __future__ import annotations

import pytest

from tests.chart.conftest import Object, containers, of_kind, pod_specs, render


def argument(objects: list[Object], end: str, flag: str) -> str:
    arguments = containers(pod_specs(objects)[end])[end]["args"]
    return next(str(word).partition("=")[2] for word in arguments if word.startswith(flag + "="))


def volume_at(objects: list[Object], end: str, path: str) -> Object:
    """Find the volume of a file by its mount path."""
    pod = pod_specs(objects)[end]
    mounts = containers(pod)[end]["volumeMounts"]
    name = next(m["name"] for m in mounts if path.startswith(m["mountPath"] + "/"))
    return next(volume for volume in pod["volumes"] if volume["name"] == name)


@pytest.mark.parametrize("end", ["world", "cloud"])
def test_world_and_cloud_read_the_key_from_the_secret(end: str) -> None:
    objects = render()
    volume = volume_at(objects, end, argument(objects, end, "--key"))
    assert volume["secret"]["secretName"] == "demo-cloudrc-tunnel"
    assert argument(objects, end, "--key").endswith("/key")


def test_the_link_sees_no_key() -> None:
    for end in ("world", "cloud"):
        mounts = containers(pod_specs(render())[end])["link"]["volumeMounts"]
        assert "secret" not in {mount["name"] for mount in mounts}


def test_world_needs_no_volume_for_its_epochs() -> None:
    """The value of older releases is accepted."""
    objects = render({"world": {"epochs": {"storageClassName": "fast"}}})
    assert set(of_kind(objects, "PersistentVolumeClaim")) == {"journal"}
