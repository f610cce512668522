"""`cloudrc run --mode cluster` from the flags to the report, on a fake cluster."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cluster import flight
from cloudrc.cluster import pods as fetch
from cloudrc.cluster.client import Release, connect
from cloudrc.cluster.jobs import run_job
from cloudrc.cluster.tools import ClusterError
from cloudrc.config.load import load_experiment
from tests.cluster.conftest import FakeApi
from tests.cluster.test_cut import HOVER, SECOND, flown, later, merged
from tests.cluster.test_jobs import at_look, end, start_pod, terminated

Patch = pytest.MonkeyPatch
NAME, (SETTING,) = HOVER
MISSIONS: list[dict[str, str]] = []
"""Missions that the fake API of teleop returns."""
LINE = ["run", NAME, "--set", SETTING, "--mode", "cluster", "-o", "json"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(flight, "FLUSH", 0.0)
    monkeypatch.setattr("cloudrc.report.write._write_page", lambda *arguments: None)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def metrics_port() -> Iterator[int]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            if self.path == "/v1/missions":
                self.wfile.write(json.dumps({"missions": MISSIONS}).encode())
            else:
                self.wfile.write(b'cloudrc_link_info{direction="uplink",shaper="relay"} 1.0\n')

        def log_message(self, *words: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    yield server.server_port
    server.shutdown()
    server.server_close()


@pytest.fixture
def pods(
    running: FakeApi, pretend: Callable[[str, str], Path], tmp_path: Path, metrics_port: int
) -> FakeApi:
    """A release whose pods have recorded a flight, and whose Jobs end at once."""
    world, _ = flown()
    merged(tmp_path, flown(), (later(world[-300:], SECOND), []), torn=True)
    pretend("helm", f"echo $@ >> {tmp_path}/helm; test $1 = list && echo '[]' || cat > /dev/null")
    opened = "\n".join(
        f"echo 'Forwarding from 127.0.0.1:{metrics_port} -> {port}'"
        for port in (8080, 9100, 9101, 9102)
    )
    pretend(
        "kubectl",
        f'case "$*" in *exec*world*) cat {tmp_path}/world.mcap ;;'
        f" *exec*cloud*) cat {tmp_path}/cloud.mcap ;; *) {opened}\nexec sleep 60 ;; esac",
    )
    return running


def ending(api: FakeApi, kind: str, exit_code: int, message: str) -> Callable[[], None]:
    def action() -> None:
        (name,) = [key[2] for key in api.objects if key[0] == "jobs"]
        start_pod(api, name, state=terminated(exit_code, message))
        api.logs[f"{name}-x"] = "waypoint 1 of 1 reached at 3.00 s\n"
        end(api, name, kind)

    return action


def test_a_flight_on_a_cluster_writes_a_whole_run(
    pods: FakeApi, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "two.py").write_text("UNIT = '1'\ndef measure(flight):\n    return 2.0\n")
    at_look(pods, 2, ending(pods, "Complete", 0, "mission done"))
    code = main([*LINE, "--out", "out", "--set", "report.metrics=./two.py"])
    captured = capsys.readouterr()
    assert "waypoint 1 of 1 reached" in captured.err
    report = json.loads(captured.out)
    # The recording was made in virtual time, so it does not prove real time.
    assert (code, report["verdict"]) == (6, "invalid")
    assert (report["mode"], report["shaper"]) == ("cluster", "relay")
    assert report["complete"]
    assert report["numbers"]["waypoints_reached"]["value"] == 1
    assert report["numbers"]["two"]["value"] == 2.0, "measured here, not in a pod"
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"config.yaml", "mission.mcap", "report.json", "environment.json"} <= left
    assert {"world.mcap", "cloud.mcap", "world-link.metrics", "cloud-teleop.log"} <= left
    assert not (tmp_path / "runs").exists()
    assert "upgrade --install cloudrc" in (tmp_path / "helm").read_text()


@pytest.mark.parametrize("out", [[], ["--out", "out"]], ids=["runs", "out"])
def test_a_refused_mission_leaves_no_run(
    pods: FakeApi, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: list[str]
) -> None:
    at_look(pods, 2, ending(pods, "Failed", 5, "mission m-1 is under way"))
    assert main([*LINE, *out]) == 5
    said = capsys.readouterr().err
    assert "did not fly its mission: mission m-1 is under way" in said
    assert "what was recorded" not in said
    assert not (tmp_path / "out").exists()
    assert list((tmp_path / "runs").glob("*")) == []


def test_a_run_on_a_cluster_becomes_the_latest_one(pods: FakeApi, tmp_path: Path) -> None:
    at_look(pods, 2, ending(pods, "Complete", 0, "mission done"))
    assert main(LINE) == 6
    assert (tmp_path / "runs" / "latest" / "report.json").is_file()


@pytest.mark.parametrize("left", [True, False], ids=["left", "nothing"])
def test_the_recording_from_before_a_restart_is_copied(
    pods: FakeApi,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    pretend: Callable[[str, str], Path],
    left: bool,
) -> None:
    (key,) = [key for key in pods.objects if key[0] == "pods" and "world" in key[2]]
    pods.objects[key]["status"]["containerStatuses"][0]["restartCount"] = 1
    other = (tmp_path / "bin" / "kubectl").read_text().removeprefix("#!/bin/sh\n")
    before = "echo before; exit 0" if left else "echo 'cat: no such file' >&2; exit 1"
    pretend("kubectl", f'case "$*" in *before*) {before} ;; esac\n{other}')
    at_look(pods, 2, ending(pods, "Complete", 0, "mission done"))
    assert main([*LINE, "--out", "out"]) == 6
    out, said = tmp_path / "out", capsys.readouterr().err
    assert not (out / "cloud.before.mcap").exists()
    assert (out / "world.before.mcap").exists() is left
    assert "world was restarted" in said
    if left:
        assert (out / "world.before.mcap").read_text() == "before\n"


def test_a_broken_port_forward_loses_metrics_but_no_report(
    pods: FakeApi, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Patch
) -> None:
    calls: list[str] = []

    def broken(release: object, component: str) -> dict[str, str]:
        raise ClusterError("no way to the pod")

    def hiccup(release: Release, component: str, target: Path) -> None:
        calls.append(component)
        if len(calls) == 1:
            raise ClusterError("kubectl exec failed")
        fetch_recording(release, component, target)

    fetch_recording = fetch.fetch_recording
    monkeypatch.setattr(fetch, "fetch_metrics", broken)
    monkeypatch.setattr(fetch, "fetch_recording", hiccup)
    at_look(pods, 2, ending(pods, "Complete", 0, "mission done"))
    assert main([*LINE, "--out", "out"]) == 6
    captured = capsys.readouterr()
    assert json.loads(captured.out)["shaper"] == "unknown"
    assert "without the world pod's metrics: no way to the pod" in captured.err
    assert "kubectl exec failed; trying again" in captured.err
    assert (tmp_path / "out" / "cloud-teleop.log").is_file()


def test_a_run_does_not_end_a_flight_in_progress(
    pods: FakeApi, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Patch
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "MISSIONS", [{"id": "m7", "state": "held"}])
    assert main([*LINE, "--out", "out"]) == 5
    said = capsys.readouterr().err
    assert "mission m7 is under way on release 'cloudrc'" in said
    assert "end it: cloudrc mission cancel --namespace=demo --release=cloudrc, or" in said
    monkeypatch.setattr(sys.modules[__name__], "MISSIONS", [{"id": "m7", "state": "done"}])
    run_job(connect(), {}, name="first")
    assert main([*LINE, "--out", "out"]) == 5
    said = capsys.readouterr().err
    assert "Job 'first' is under way" in said
    assert "cloudrc mission cancel first --namespace=demo --release=cloudrc" in said
    assert not (tmp_path / "helm").exists()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["hover", "--set", "cloud.predictor=./mine.py"], "the pods do not have this file"),
        (["hover", "--set", "world.scene=./mine.xml"], "world.scene: /"),
        (["steps"], "mission.steps"),
    ],
)
def test_what_pods_cannot_have_is_refused_before_the_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: list[str], words: str
) -> None:
    plugin = "from cloudrc.cloud.predictors.last_sample import build as build\n"
    (tmp_path / "mine.py").write_text(plugin)
    (tmp_path / "mine.xml").write_text("<mujoco/>")
    assert main(["run", *settings, "--mode", "cluster"]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_an_upgrade_keeps_the_values_of_a_release() -> None:
    before = {"metrics": {"allowFrom": ["x"]}, "link": {"mode": "relay", "profile": "paper-p1"}}
    given = flight.chart_values(load_experiment("hover"), before)
    assert given["metrics"] == before["metrics"]
    assert given["link"] == {"mode": "relay", "profile": ""}
    assert given["experiment"]["name"] == "hover"


def test_a_run_disables_the_charts_own_mission() -> None:
    before = {"mission": {"enabled": True, "queue": True}}
    given = flight.chart_values(load_experiment("hover"), before)
    assert given["mission"] == {"enabled": False, "queue": True}
