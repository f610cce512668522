"""Metrics and routes of real processes: a whole flight, and names that cannot be resolved."""

import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import suppress

import pytest

from cloudrc.config.load import dump, load_experiment
from cloudrc.drivers.realtime import free_ports


class Pods:
    """World and cloud with metrics, connected by two route files."""

    def __init__(self, folder):
        self.folder = folder
        experiment = load_experiment("hover", ["mission.waypoints.0.dwell_s=60"])
        (folder / "experiment.yaml").write_text(dump(experiment))
        (folder / "key").write_bytes(b"k" * 32)
        ports = free_ports(4)
        self.tunnel = {"world": ports[0], "cloud": ports[1]}
        self.metrics = {"world": ports[2], "cloud": ports[3]}
        self.processes = {end: self.start(end) for end in ("world", "cloud")}

    def start(self, end):
        command = [sys.executable, "-m", "cloudrc", end]
        command += ["--config", str(self.folder / "experiment.yaml")]
        command += ["--key", str(self.folder / "key")]
        command += ["--listen", f"127.0.0.1:{self.tunnel[end]}"]
        command += ["--route", str(self.folder / f"{end}.route")]
        command += ["--metrics", f"127.0.0.1:{self.metrics[end]}"]
        if end == "world":
            command += ["--record", str(self.folder / "world.mcap")]
        with (self.folder / f"{end}.log").open("wb") as log:
            return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)

    def route(self, end, port):
        draft = self.folder / "draft"
        draft.write_text(f"127.0.0.1:{port}\n")
        draft.replace(self.folder / f"{end}.route")

    def get(self, end, path):
        url = f"http://127.0.0.1:{self.metrics[end]}{path}"
        try:
            with urllib.request.urlopen(url, timeout=5) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, ""
        except urllib.error.URLError:
            return 0, ""

    def wait(self, end, path, *wanted, status=200, limit=15):
        until = time.monotonic() + limit
        while True:
            got, text = self.get(end, path)
            if got == status and all(line in text for line in wanted):
                return
            assert time.monotonic() < until, (got, text, (self.folder / f"{end}.log").read_text())
            time.sleep(0.05)

    def stop(self):
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            process.wait(5)


@pytest.fixture
def pods(tmp_path):
    made = Pods(tmp_path)
    yield made
    made.stop()


@pytest.mark.process
def test_ends_follow_their_route_and_are_ready_only_with_a_peer(pods):
    for end in pods.processes:
        pods.wait(end, "/healthz")
        assert pods.get(end, "/readyz")[0] == 503
    pods.route("world", pods.tunnel["cloud"])
    pods.route("cloud", pods.tunnel["world"])
    for end in pods.processes:
        pods.wait(end, "/readyz")
    pods.wait("world", "/metrics", "cloudrc_guard_state 1.0", "cloudrc_real_time_factor ")
    pods.wait("world", "/metrics", "cloudrc_recorder_sync_age_seconds ")
    assert "sync_age" not in pods.get("cloud", "/metrics")[1], "it records nothing"
    pods.wait("cloud", "/metrics", "cloudrc_mission_state 2.0", 'cloudrc_pid_output{axis="x"')
    pods.route("world", 9)  # discard port: cloud receives nothing more, world still does
    pods.wait("cloud", "/readyz", status=503)
    assert pods.get("cloud", "/healthz")[0] == 200
    pods.route("world", pods.tunnel["cloud"])
    pods.wait("cloud", "/readyz")
    asked = time.monotonic()
    for process in pods.processes.values():
        process.send_signal(signal.SIGTERM)
    assert [process.wait(5) for process in pods.processes.values()] == [0, 0]
    assert time.monotonic() - asked < 2.0


@pytest.mark.process
def test_a_link_counts_unresolved_names_before_it_shapes(tmp_path):
    (tmp_path / "profile.yaml").write_text("uplink: {delay_ms: 1}\n")
    listen, metrics = free_ports(2)
    command = [sys.executable, "-m", "cloudrc", "link", "run", "--config", "hover"]
    command += ["--profile", str(tmp_path / "profile.yaml"), "--direction", "uplink"]
    command += ["--mode", "relay", "--peer", "no..name:7400", "--route", str(tmp_path / "route")]
    command += ["--listen", f"127.0.0.1:{listen}", "--metrics", f"127.0.0.1:{metrics}"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as link:
        try:
            until, errors = time.monotonic() + 15, 0.0
            while errors < 1:
                assert time.monotonic() < until
                time.sleep(0.05)
                with suppress(OSError):
                    url = f"http://127.0.0.1:{metrics}/metrics"
                    page = urllib.request.urlopen(url, timeout=5).read().decode()
                    errors = float(page.partition("\ncloudrc_dns_errors_total ")[2].split()[0])
        finally:
            link.terminate()
