"""The tunnel's key is made once, kept, or somebody else's; it rolls no pod and is not printed."""

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


def test_an_upgrade_finds_it_and_uninstalling_keeps_it() -> None:
    installed = render(lookup=a_namespace())
    upgraded = render(lookup=holding(installed, a_namespace()))
    assert upgraded == installed
    secret = of_kind(upgraded, "Secret")["tunnel"]
    assert secret["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"


def test_nothing_but_the_secret_differs_between_two_renderings() -> None:
    """Argo CD renders without a cluster: a random key must not roll the pods."""
    first, second = render(), render()
    differ = [a["kind"] for a, b in zip(first, second, strict=True) if a != b]
    assert set(differ) == {"Secret"}


def test_ones_own_comes_first() -> None:
    there = holding([{"kind": "Secret", "metadata": {"name": "lab-key"}}], a_namespace())
    objects = render(OURS, lookup=there)
    assert "tunnel" not in of_kind(objects, "Secret")
    assert {secret_volume(pod_specs(objects)[end]) for end in ("world", "cloud")} == {"lab-key"}


def test_a_missing_one_is_refused_with_the_command_that_makes_it() -> None:
    said = "no Secret 'lab-key' in namespace 'lab'; make it: .* create secret generic lab-key"
    with pytest.raises(Exception, match=said):
        render(OURS, lookup=a_namespace())


def test_without_a_cluster_it_is_taken_on_trust() -> None:
    assert "tunnel" not in of_kind(render(OURS), "Secret")


def test_it_is_not_printed() -> None:
    secret = of_kind(render(), "Secret")["tunnel"]
    assert secret["data"]["key"] not in notes()
    for pod in pod_specs(render()).values():
        assert "secretKeyRef" not in str(pod)
