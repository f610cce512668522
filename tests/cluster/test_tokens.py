"""The token of a release's API is read from its Secret; errors never contain it."""

from __future__ import annotations

import base64

import pytest

from cloudrc.cluster.client import Release
from cloudrc.cluster.jobs import run_job
from cloudrc.cluster.pods import operator_token, secret_name
from cloudrc.cluster.tools import ClusterError
from tests.cluster.conftest import FakeApi


def test_the_token_is_from_the_secret_that_the_pod_mounts(
    running: FakeApi, release: Release
) -> None:
    assert secret_name(release) == "cloudrc-tokens"
    assert operator_token(release) == "operator-token-of-the-release"


def test_a_missing_right_to_read_the_token_is_reported(running: FakeApi, release: Release) -> None:
    running.refuse["GET", "secrets"] = (403, "secrets is forbidden")
    with pytest.raises(ClusterError, match="secrets"):
        operator_token(release)


@pytest.mark.parametrize("data", [{}, {"reader": "eA=="}, {"operator": "%%%"}])
def test_a_secret_without_a_token_is_named(
    running: FakeApi, release: Release, data: dict[str, str]
) -> None:
    running.get("secrets", "cloudrc-tokens")["data"] = data
    with pytest.raises(ClusterError, match=r"Secret 'cloudrc-tokens' .* has no token under"):
        operator_token(release)


def test_a_token_that_is_not_text_is_not_printed(running: FakeApi, release: Release) -> None:
    data = {"operator": base64.b64encode(b"\xff\xfe secret").decode()}
    running.get("secrets", "cloudrc-tokens")["data"] = data
    with pytest.raises(ClusterError) as refused:
        operator_token(release)
    assert "secret'" not in str(refused.value)


def test_a_release_without_tokens_is_reported(running: FakeApi, release: Release) -> None:
    running.get("pods", "cloud-1")["spec"]["volumes"] = []
    with pytest.raises(
        ClusterError, match="mounts no tokens: it has another version of the chart; upgrade it"
    ):
        secret_name(release)


def test_a_job_mounts_only_the_operators_token(running: FakeApi, release: Release) -> None:
    run_job(release, {"waypoints": []}, name="first")
    pod = running.get("jobs", "first")["spec"]["template"]["spec"]
    volume = next(v["secret"] for v in pod["volumes"] if v["name"] == "tokens")
    assert volume["secretName"] == "cloudrc-tokens"
    assert volume["items"] == [{"key": "operator", "path": "operator"}]
    (container,) = pod["containers"]
    assert "--token-file=/etc/cloudrc-tokens/operator" in container["args"]
    assert "operator-token" not in str(running.get("jobs", "first"))
