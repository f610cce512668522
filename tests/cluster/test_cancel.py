"""A mission is cancelled by its Job's name, in every state of the Job."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from cloudrc.cluster.client import Release
from cloudrc.cluster.jobs import cancel, run_job
from cloudrc.cluster.tools import ClusterError
from tests.cluster.conftest import FakeApi
from tests.cluster.test_jobs import MISSION, end


class FakeTeleop(ThreadingHTTPServer):
    """A fake API of teleop, with a record of its requests."""

    def __init__(self) -> None:
        self.missions: list[dict[str, str]] = []
        self.posted: list[str] = []
        self.tokens: set[str | None] = set()
        self.refuses = False
        teleop = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.answer(200, {"missions": teleop.missions})

            def do_POST(self) -> None:
                teleop.posted.append(self.path)
                self.answer(409, {"detail": "it is over"}) if teleop.refuses else self.answer(
                    200, {}
                )

            def answer(self, code: int, body: object) -> None:
                teleop.tokens.add(self.headers["Authorization"])
                self.send_response(code)
                self.end_headers()
                self.wfile.write(json.dumps(body).encode())

            def log_message(self, *words: object) -> None:
                pass

        super().__init__(("127.0.0.1", 0), Handler)


@pytest.fixture
def teleop(running: FakeApi, pretend: Callable[[str, str], Path]) -> Iterator[FakeTeleop]:
    server = FakeTeleop()
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    way = f"echo 'Forwarding from 127.0.0.1:{server.server_port} -> 8080'"
    pretend("kubectl", f"{way}\nexec sleep 60")
    yield server
    server.shutdown()
    server.server_close()


def test_the_mission_of_a_job_is_found_by_its_key(teleop: FakeTeleop, release: Release) -> None:
    job = run_job(release, MISSION, name="first")
    teleop.missions = [{"id": "m1", "key": "another"}, {"id": "m2", "key": job.uid, "name": "up"}]
    assert cancel(release, "first") == "mission m2 (up) of Job 'first' is cancelled"
    assert teleop.posted == ["/v1/missions/m2/cancel"]
    assert teleop.tokens == {"Bearer operator-token-of-the-release"}


def test_a_job_that_has_not_posted_yet_is_deleted(
    running: FakeApi, teleop: FakeTeleop, release: Release
) -> None:
    run_job(release, MISSION, name="first")
    assert "deleted" in cancel(release, "first")
    assert teleop.posted == []
    assert ("jobs", "demo", "first") not in running.objects


def test_without_a_cloud_pod_the_job_is_deleted(
    running: FakeApi, teleop: FakeTeleop, release: Release
) -> None:
    """No API can cancel the mission, and the Job would wait until its deadline."""
    run_job(release, MISSION, name="first")
    running.get("pods", "cloud-1")["status"]["phase"] = "Pending"
    said = cancel(release, "first")
    assert "'first' is deleted" in said
    assert "cloudrc mission cancel --namespace=demo --release=cloudrc" in said
    assert ("jobs", "demo", "first") not in running.objects
    assert teleop.posted == []


def test_cancelling_an_ended_job_changes_nothing(
    running: FakeApi, teleop: FakeTeleop, release: Release
) -> None:
    run_job(release, MISSION, name="first")
    end(running, "first", "Complete")
    assert "has ended already" in cancel(release, "first")
    assert teleop.posted == []


def test_a_refusal_of_the_api_is_reported(teleop: FakeTeleop, release: Release) -> None:
    job = run_job(release, MISSION, name="first")
    teleop.missions, teleop.refuses = [{"id": "m1", "key": job.uid, "name": ""}], True
    with pytest.raises(ClusterError, match="it is over"):
        cancel(release, "first")


def test_a_given_token_is_sent(teleop: FakeTeleop, release: Release) -> None:
    job = run_job(release, MISSION, name="first")
    teleop.missions = [{"id": "m2", "name": "hop", "key": job.uid}]
    cancel(release, "first", "a-token-of-mine-alone")
    assert teleop.tokens == {"Bearer a-token-of-mine-alone"}
