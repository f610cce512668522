"""The exact mounts of each container: an attacker in a container gets no more than these."""

from __future__ import annotations

import pytest

from tests.chart.conftest import Object, a_namespace, containers, pod_specs, render

END = {"experiment ro", "secret ro", "run", "data"}
LINK = {"experiment ro", "link ro", "run"}
MISSION = {"mission ro", "tokens ro"}
MOUNTS = {
    "world": {"link": LINK, "world": END},
    "cloud": {
        "link": LINK,
        "cloud": END | {"teleop"},
        "teleop": {"experiment ro", "teleop", "tokens ro", "journal"},
        "load": set(),
    },
    "mission": {"mission": MISSION},
    "test": {"test": MISSION},
    "test-link": {"test-link": set()},
}
KEY = {"secretName": "demo-cloudrc-tunnel", "defaultMode": 0o440}
TOKENS = {"secretName": "demo-cloudrc-tokens", "defaultMode": 0o440}
OPERATOR = {**TOKENS, "items": [{"key": "operator", "path": "operator"}]}
SECRETS = {
    "world": {"secret": KEY},
    "cloud": {"secret": KEY, "tokens": TOKENS},
    "mission": {"tokens": OPERATOR},
    "test": {"tokens": OPERATOR},
    "test-link": {},
}
each_mode = pytest.mark.parametrize("mode", ["relay", "netem", "auto"])


def pods(mode: str) -> dict[str, Object]:
    load = {"backgroundLoad": {"enabled": True}}
    values = {"link": {"mode": mode}, "mission": {"enabled": True}, "cloud": load}
    return pod_specs(render(values, lookup=a_namespace()))


def mounts(container: Object) -> set[str]:
    """Return the names of the mounted volumes, with " ro" added if read-only."""
    found = container.get("volumeMounts", [])
    return {mount["name"] + " ro" * mount.get("readOnly", False) for mount in found}


@each_mode
def test_a_container_mounts_only_what_it_needs(mode: str) -> None:
    assert MOUNTS == {
        pod: {name: mounts(container) for name, container in containers(spec).items()}
        for pod, spec in pods(mode).items()
    }


@each_mode
def test_only_owner_and_group_can_read_a_secret(mode: str) -> None:
    assert SECRETS == {
        pod: {v["name"]: v["secret"] for v in spec.get("volumes", ()) if "secret" in v}
        for pod, spec in pods(mode).items()
    }


@each_mode
def test_the_link_mounts_no_key_no_token_and_no_teleop_socket(mode: str) -> None:
    found = pods(mode)
    for end in ("world", "cloud"):
        volumes = {volume["name"]: volume for volume in found[end]["volumes"]}
        link = containers(found[end])["link"]
        kinds = {m["name"]: set(volumes[m["name"]]) - {"name"} for m in link["volumeMounts"]}
        assert kinds == {"experiment": {"configMap"}, "link": {"configMap"}, "run": {"emptyDir"}}
        assert not found[end].get("shareProcessNamespace"), "/proc/PID/root is another way in"
    cloud = containers(found["cloud"])
    (folder,) = (a.split("=")[1] for a in cloud["cloud"]["args"] if a.startswith("--teleop="))
    assert f"--socket={folder}" in cloud["teleop"]["args"]
    for name in ("cloud", "teleop"):
        where = {m["mountPath"]: m["name"] for m in cloud[name]["volumeMounts"]}
        assert where[folder] == "teleop", "no folder above it, which a link may mount"


def test_volumes_in_memory_are_small() -> None:
    memory = {
        pod: {v["name"]: v["emptyDir"] for v in spec.get("volumes", ()) if "emptyDir" in v}
        for pod, spec in pods("relay").items()
    }
    run = {"medium": "Memory", "sizeLimit": "4Mi"}
    for pod in ("world", "cloud"):
        assert memory[pod].pop("data").keys() == {"sizeLimit"}
    assert memory.pop("cloud") == {"run": run, "teleop": {"medium": "Memory", "sizeLimit": "1Mi"}}
    assert memory.pop("world") == {"run": run}
    assert not any(memory.values())
