"""The API's tokens: made once and kept, or an existing Secret; a pod gets only what it needs."""

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

OURS: Object = {"teleop": {"tokens": {"existingSecret": "lab-tokens"}}}
MISSION: Object = {"mission": {"enabled": True}}


def tokens(objects: list[Object]) -> Object:
    return of_kind(objects, "Secret")["tokens"]


def mounted(pod: Object) -> Object | None:
    found = [v["secret"] for v in pod["volumes"] if v["name"] == "tokens"]
    return found[0] if found else None


def test_two_different_tokens_are_made() -> None:
    data = tokens(render())["data"]
    operator, reader = (base64.b64decode(data[role]) for role in ("operator", "reader"))
    assert len(operator) == len(reader) == 48
    assert operator != reader


def test_upgrade_and_uninstall_keep_the_tokens() -> None:
    installed = render(lookup=a_namespace())
    upgraded = render(lookup=holding(installed, a_namespace()))
    assert tokens(upgraded) == tokens(installed)
    assert tokens(upgraded)["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"


def test_existing_tokens_are_used() -> None:
    there = holding([{"kind": "Secret", "metadata": {"name": "lab-tokens"}}], a_namespace())
    objects = render({**OURS, **MISSION}, lookup=there)
    assert "tokens" not in of_kind(objects, "Secret")
    pods = pod_specs(objects)
    names = {(mounted(pods[pod]) or {})["secretName"] for pod in ("cloud", "mission", "test")}
    assert names == {"lab-tokens"}


def test_missing_tokens_are_refused_with_a_command() -> None:
    said = "no Secret 'lab-tokens' in namespace 'lab'; make it: .* --from-file=operator"
    with pytest.raises(Exception, match=said):
        render(OURS, lookup=a_namespace())


def test_teleop_mounts_all_tokens_and_missions_the_operators() -> None:
    pods = pod_specs(render(MISSION))
    assert mounted(pods["world"]) is None
    assert "items" not in (mounted(pods["cloud"]) or {})
    for pod in ("mission", "test"):
        (item,) = (mounted(pods[pod]) or {})["items"]
        assert item == {"key": "operator", "path": "operator"}
        (container,) = pods[pod]["containers"]
        assert "--token-file=/etc/cloudrc-tokens/operator" in container["args"]
    mounts = {
        name: [m["name"] for m in container["volumeMounts"]]
        for name, container in containers(pods["cloud"]).items()
    }
    assert [name for name, found in mounts.items() if "tokens" in found] == ["teleop"]


def test_the_api_has_tokens_and_an_audit_log() -> None:
    teleop = containers(pod_specs(render())["cloud"])["teleop"]
    assert "--tokens=/etc/cloudrc-tokens" in teleop["args"]
    assert [a for a in teleop["args"] if a.startswith("--audit=/var/lib/cloudrc-journal/")]


def test_tokens_are_in_no_output_and_no_environment() -> None:
    objects = render(MISSION)
    data = tokens(objects)["data"]
    for pod in pod_specs(objects).values():
        assert "secretKeyRef" not in str(pod)
    for token in data.values():
        assert token not in notes()
        assert base64.b64decode(token).decode() not in notes()
