"""The tunnel's key: made once and kept, or an existing Secret; never printed."""

from __future__ import annotations

import base64

import pytest

from tests.chart.conftest import a_namespace, holding, notes, of_kind, pod_specs, render

OURS = {"secret": {"existingSecret": "lab-key"}}


def secret_volume(pod: dict[str, object]) -> str:
    volumes = pod["volumes"]
    assert isinstance(volumes, list)
    return next(v["secret"]["secretName"] for v in volumes if v["name"] == "secret")


def test_a_key_of_32_bytes_is_made() -> None:
    secret = of_kind(render(), "Secret")["tunnel"]
    assert len(base64.b64decode(secret["data"]["key"])) == 32


def test_upgrade_and_uninstall_keep_the_key() -> None:
    installed = render(lookup=a_namespace())
    upgraded = render(lookup=holding(installed, a_namespace()))
    assert upgraded == installed
    secret = of_kind(upgraded, "Secret")["tunnel"]
    assert secret["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"


def test_two_renderings_differ_only_in_the_secret() -> None:
    """Argo CD renders without a cluster: a random key must not restart the pods."""
    first, second = render(), render()
    differ = [a["kind"] for a, b in zip(first, second, strict=True) if a != b]
    assert set(differ) == {"Secret"}


def test_an_existing_secret_is_used() -> None:
    there = holding([{"kind": "Secret", "metadata": {"name": "lab-key"}}], a_namespace())
    objects = render(OURS, lookup=there)
    assert "tunnel" not in of_kind(objects, "Secret")
    assert {secret_volume(pod_specs(objects)[end]) for end in ("world", "cloud")} == {"lab-key"}


def test_a_missing_secret_is_refused_with_a_command() -> None:
    said = "no Secret 'lab-key' in namespace 'lab'; make it: .* create secret generic lab-key"
    with pytest.raises(Exception, match=said):
        render(OURS, lookup=a_namespace())


def test_without_a_cluster_the_secret_is_not_checked() -> None:
    assert "tunnel" not in of_kind(render(OURS), "Secret")


def test_the_key_is_not_printed() -> None:
    secret = of_kind(render(), "Secret")["tunnel"]
    assert secret["data"]["key"] not in notes()
    for pod in pod_specs(render()).values():
        assert "secretKeyRef" not in str(pod)
