"""A short outage of the API server loses no line and no verdict of a flight."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from cloudrc.cluster import tools
from cloudrc.cluster.client import Release
from cloudrc.cluster.jobs import follow, run_job
from cloudrc.cluster.release import wait_ready
from cloudrc.cluster.tools import ClusterError, UnavailableError
from tests.cluster.conftest import FakeApi
from tests.cluster.test_jobs import MISSION, end, start_pod, terminated


def away(api: FakeApi, plural: str, code: int, times: int) -> Callable[[], int]:
    """Refuse a number of read requests; return a function that counts those left."""
    original, left = api.answer, times

    def answer(method: str, path: str, body: Any) -> tuple[int, Any]:
        nonlocal left
        if method == "GET" and f"/{plural}" in path and left:
            left -= 1
            return code, {"message": "etcdserver: leader changed", "code": code}
        return original(method, path, body)

    api.answer = answer  # type: ignore[method-assign]
    return lambda: left


@pytest.mark.parametrize("plural", ["jobs", "pods"])
@pytest.mark.parametrize("code", [429, 500, 503])
def test_follow_survives_an_outage(
    running: FakeApi, release: Release, plural: str, code: int
) -> None:
    run_job(release, MISSION, name="first")
    start_pod(running, "first", state=terminated(0, "done"))
    running.logs["first-x"] = "waypoint 1 of 1 reached\n"
    end(running, "first", "Complete")
    left = away(running, plural, code, 3)
    lines: list[str] = []
    assert follow(release, "first", lines.append, timeout=10.0).exit_code == 0
    assert left() == 0
    told, last = lines
    assert "leader changed" in told
    assert "trying again" in told
    assert last == "waypoint 1 of 1 reached"


def test_the_wait_for_a_release_survives_an_outage(running: FakeApi, release: Release) -> None:
    left = away(running, "deployments", 500, 2)
    wait_ready(release, timeout=10.0)
    assert left() == 0


def test_a_refusal_is_not_repeated(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    left = away(running, "jobs", 403, 5)
    with pytest.raises(ClusterError, match="can-i get jobs"):
        follow(release, "first", print, timeout=10.0)
    assert left() == 4


def test_a_long_outage_ends_the_wait(
    running: FakeApi, release: Release, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tools, "OUTAGE_MAX", 0.05)
    run_job(release, MISSION, name="first")
    away(running, "jobs", 500, 1_000_000)
    with pytest.raises(UnavailableError, match="leader changed") as caught:
        follow(release, "first", lambda line: None, timeout=10.0)
    assert caught.value.exit_code == 5
