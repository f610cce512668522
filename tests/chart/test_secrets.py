"""Key and tokens are made once and kept; a container mounts no more than it needs."""

import base64

import pytest

from tests.chart.conftest import a_namespace, containers, notes, nothing, of_kind, pod_specs, render

OURS = {
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
        "teleop": {"experiment ro", "run ro", "teleop", "tokens ro", "journal"},
        "load": set(),
    },
    "mission": {"mission": MISSION},
    "test": {"test": MISSION},
    "test-link": {"test-link": set()},
}
"""Pod -> container -> its mounts; an attacker in the container can reach only these."""
KEY = {"secretName": "demo-cloudrc-tunnel", "defaultMode": 0o440}
TOKENS = {"secretName": "demo-cloudrc-tokens", "defaultMode": 0o440}
OPERATOR = {**TOKENS, "items": [{"key": "operator", "path": "operator"}]}
RUN, TELEOP = ({"medium": "Memory", "sizeLimit": size} for size in ("4Mi", "1Mi"))
DATA = {"sizeLimit": "1Gi"}
VOLUMES = {
    "world": {"secret": KEY, "run": RUN, "data": DATA},
    "cloud": {"secret": KEY, "tokens": TOKENS, "run": RUN, "teleop": TELEOP, "data": DATA},
    "mission": {"tokens": OPERATOR},
    "test": {"tokens": OPERATOR},
    "test-link": {},
}
"""Pod -> its volumes of Secrets and in memory or on disk."""


def test_key_and_tokens_are_made_once_and_kept():
    installed = render(lookup=a_namespace())
    secrets = of_kind(installed, "Secret")
    assert len(base64.b64decode(secrets["tunnel"]["data"]["key"])) == 32
    data = secrets["tokens"]["data"]
    operator, reader = (base64.b64decode(data[role]) for role in ("operator", "reader"))
    assert len(operator) == len(reader) == 48
    assert operator != reader
    assert render(lookup=a_namespace(objects=installed)) == installed
    for secret in secrets.values():
        assert secret["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"


def test_two_renderings_differ_only_in_the_secrets():
    """Argo CD renders without a cluster: a random key must not restart the pods."""
    pairs = zip(render(), render(), strict=True)
    assert {first["kind"] for first, second in pairs if first != second} == {"Secret"}


def test_existing_secrets_are_used():
    there = [{"kind": "Secret", "metadata": {"name": f"lab-{name}"}} for name in ("key", "tokens")]
    for lookup in (a_namespace(objects=there), nothing):
        objects = render(OURS, lookup=lookup)
        assert not of_kind(objects, "Secret")
        volumes = {pod: str(spec.get("volumes")) for pod, spec in pod_specs(objects).items()}
        assert "lab-key" in volumes["world"]
        assert all("lab-tokens" in volumes[pod] for pod in ("cloud", "mission", "test"))


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("secret", "no Secret 'lab-key' in namespace 'lab'; make it: .* generic lab-key"),
        ("teleop", "no Secret 'lab-tokens' in namespace 'lab'; make it: .* --from-file=operator"),
    ],
)
def test_a_missing_secret_is_refused_with_a_command(key, said):
    with pytest.raises(Exception, match=said):
        render({key: OURS[key]}, lookup=a_namespace())


def test_secrets_are_in_no_output_and_no_environment():
    objects, printed = render({"mission": {"enabled": True}}), notes()
    assert not any("secretKeyRef" in str(pod) for pod in pod_specs(objects).values())
    for secret in of_kind(objects, "Secret").values():
        for text in secret["data"].values():
            assert text not in printed
            assert base64.b64decode(text).decode("latin-1") not in printed


@pytest.mark.parametrize("mode", ["relay", "netem"])
def test_a_container_mounts_only_what_it_needs(mode):
    load = {"backgroundLoad": {"enabled": True}}
    values = {"link": {"mode": mode}, "mission": {"enabled": True}, "cloud": load}
    found = pod_specs(render(values, lookup=a_namespace()))

    def mounts(container):
        listed = container.get("volumeMounts", [])
        assert not any("subPath" in mount for mount in listed), "it gets no changed ConfigMap"
        return {mount["name"] + " ro" * mount.get("readOnly", False) for mount in listed}

    def volumes(spec):
        kinds = {v["name"]: v.get("secret") or v.get("emptyDir") for v in spec.get("volumes", ())}
        return {name: volume for name, volume in kinds.items() if volume}

    def folder(part, flag):
        """Return the volume that is mounted at the path in an argument, or at its parent folder."""
        (path,) = (a.partition("=")[2] for a in part["args"] if a.startswith(f"--{flag}="))
        where = {m["mountPath"]: m["name"] for m in part["volumeMounts"]}
        return where.get(path) or where[path.rpartition("/")[0]]

    assert MOUNTS == {
        pod: {name: mounts(container) for name, container in containers(spec).items()}
        for pod, spec in found.items()
    }
    assert VOLUMES == {pod: volumes(spec) for pod, spec in found.items()}
    for end in ("world", "cloud"):
        assert not found[end].get("shareProcessNamespace"), "/proc/PID/root is another way in"
        assert folder(containers(found[end])[end], "key") == "secret"
    cloud, teleop = (containers(found["cloud"])[name] for name in ("cloud", "teleop"))
    assert folder(teleop, "tokens") == "tokens"
    assert folder(cloud, "teleop") == folder(teleop, "socket") == "teleop"
