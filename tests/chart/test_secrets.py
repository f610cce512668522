"""Key and tokens are made once and kept; a container mounts no more than it needs."""

from __future__ import annotations

import base64

import pytest

from tests.chart.conftest import (
    Object,
    a_namespace,
    containers,
    holding,
    notes,
    of_kind,
    pod_specs,
    render,
)

OURS: Object = {
    "secret": {"existingSecret": "lab-key"},
    "teleop": {"tokens": {"existingSecret": "lab-tokens"}},
    "mission": {"enabled": True},
}
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
"""Pod -> container -> its mounts: an attacker in a container gets no more than these."""
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


def test_key_and_tokens_are_made_once_and_kept() -> None:
    installed = render(lookup=a_namespace())
    secrets = of_kind(installed, "Secret")
    assert len(base64.b64decode(secrets["tunnel"]["data"]["key"])) == 32
    data = secrets["tokens"]["data"]
    operator, reader = (base64.b64decode(data[role]) for role in ("operator", "reader"))
    assert len(operator) == len(reader) == 48
    assert operator != reader
    assert render(lookup=holding(installed, a_namespace())) == installed
    for secret in secrets.values():
        assert secret["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"


def test_two_renderings_differ_only_in_the_secrets() -> None:
    """Argo CD renders without a cluster: a random key must not restart the pods."""
    first, second = render(), render()
    differ = [a["kind"] for a, b in zip(first, second, strict=True) if a != b]
    assert set(differ) == {"Secret"}


def test_existing_secrets_are_used() -> None:
    there = [{"kind": "Secret", "metadata": {"name": f"lab-{name}"}} for name in ("key", "tokens")]
    for lookup in (holding(there, a_namespace()), None):
        objects = render(OURS, lookup=lookup) if lookup else render(OURS)
        assert not of_kind(objects, "Secret")
        names = {
            pod: {v["secret"]["secretName"] for v in spec["volumes"] if "secret" in v}
            for pod, spec in pod_specs(objects).items()
            if "volumes" in spec
        }
        assert (names["world"], names["cloud"]) == ({"lab-key"}, {"lab-key", "lab-tokens"})
        assert names["mission"] == names["test"] == {"lab-tokens"}


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("secret", "no Secret 'lab-key' in namespace 'lab'; make it: .* generic lab-key"),
        ("teleop", "no Secret 'lab-tokens' in namespace 'lab'; make it: .* --from-file=operator"),
    ],
)
def test_a_missing_secret_is_refused_with_a_command(key: str, said: str) -> None:
    with pytest.raises(Exception, match=said):
        render({key: OURS[key]}, lookup=a_namespace())


def test_secrets_are_in_no_output_and_no_environment() -> None:
    objects = render({"mission": {"enabled": True}})
    for pod in pod_specs(objects).values():
        assert "secretKeyRef" not in str(pod)
    printed = notes()
    for secret in of_kind(objects, "Secret").values():
        for text in secret["data"].values():
            assert text not in printed
            assert base64.b64decode(text).decode("latin-1") not in printed


def pods(mode: str) -> dict[str, Object]:
    load = {"backgroundLoad": {"enabled": True}}
    values = {"link": {"mode": mode}, "mission": {"enabled": True}, "cloud": load}
    return pod_specs(render(values, lookup=a_namespace()))


@pytest.mark.parametrize("mode", ["relay", "netem", "auto"])
def test_a_container_mounts_only_what_it_needs(mode: str) -> None:
    found = pods(mode)

    def mounts(container: Object) -> set[str]:
        listed = container.get("volumeMounts", [])
        assert not any("subPath" in mount for mount in listed), "it gets no changed ConfigMap"
        return {mount["name"] + " ro" * mount.get("readOnly", False) for mount in listed}

    assert MOUNTS == {
        pod: {name: mounts(container) for name, container in containers(spec).items()}
        for pod, spec in found.items()
    }
    assert SECRETS == {
        pod: {v["name"]: v["secret"] for v in spec.get("volumes", ()) if "secret" in v}
        for pod, spec in found.items()
    }
    run = {"medium": "Memory", "sizeLimit": "4Mi"}
    teleop = {"medium": "Memory", "sizeLimit": "1Mi"}
    memory = {
        pod: {v["name"]: v["emptyDir"] for v in spec.get("volumes", ()) if "emptyDir" in v}
        for pod, spec in found.items()
    }
    assert all(memory[end].pop("data").keys() == {"sizeLimit"} for end in ("world", "cloud"))
    wanted = {"world": {"run": run}, "cloud": {"run": run, "teleop": teleop}}
    assert {pod: volumes for pod, volumes in memory.items() if volumes} == wanted
    for end in ("world", "cloud"):
        volumes = {volume["name"]: volume for volume in found[end]["volumes"]}
        link = containers(found[end])["link"]
        kinds = {m["name"]: set(volumes[m["name"]]) - {"name"} for m in link["volumeMounts"]}
        assert kinds == {"experiment": {"configMap"}, "link": {"configMap"}, "run": {"emptyDir"}}
        assert not found[end].get("shareProcessNamespace"), "/proc/PID/root is another way in"
        (path,) = (
            a.partition("=")[2] for a in containers(found[end])[end]["args"] if "--key=" in a
        )
        where = {m["mountPath"]: m["name"] for m in containers(found[end])[end]["volumeMounts"]}
        assert where[path.removesuffix("/key")] == "secret"
    cloud = containers(found["cloud"])
    assert "--tokens=/etc/cloudrc-tokens" in cloud["teleop"]["args"]
    assert any(a.startswith("--audit=/var/lib/cloudrc-journal/") for a in cloud["teleop"]["args"])
    (folder,) = (a.split("=")[1] for a in cloud["cloud"]["args"] if a.startswith("--teleop="))
    assert f"--socket={folder}" in cloud["teleop"]["args"]
    for name in ("cloud", "teleop"):
        where = {m["mountPath"]: m["name"] for m in cloud[name]["volumeMounts"]}
        assert where[folder] == "teleop", "no folder above it, which a link may mount"
