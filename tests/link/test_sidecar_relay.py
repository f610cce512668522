"""`cloudrc link run` as a relay: a process between two sockets on 127.0.0.1."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from cloudrc.cluster.link import APPLY_SCRIPT
from cloudrc.config.load import load_experiment
from cloudrc.link.follow import Handed, write_handed
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay import RelayShaper
from cloudrc.tunnel.codec import Kind, encode_header
from tests.link.conftest import bind_loopback

pytestmark = pytest.mark.process
ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 20.0


def until(condition: Callable[[], bool], patience: float = PATIENCE) -> float:
    began = time.monotonic()
    while not condition():
        assert time.monotonic() < began + patience, "never came true"
        time.sleep(0.005)
    return time.monotonic() - began


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


class Pod:
    """A link container in relay mode, the pod's tunnel end before it and the peer behind it."""

    def __init__(self, folder: Path, profile: str, direction: str = "uplink") -> None:
        self.route, self.log = folder / "run" / "route", folder / "log"
        self.profile = folder / "profile.yaml"
        self.route.parent.mkdir()
        self.profile.write_text(profile)
        self.end, self.peer = bind_loopback(), bind_loopback()
        self.listen = ("127.0.0.1", free_port(socket.SOCK_DGRAM))
        self.metrics = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.arrived: dict[int, int] = {}
        self.sent_ns: dict[int, int] = {}
        command = [sys.executable, "-m", "cloudrc", "link", "run", "--config", "paper"]
        command += ["--profile", str(self.profile), "--direction", direction, "--mode", "relay"]
        command += ["--peer", f"localhost:{self.peer.getsockname()[1]}"]
        command += ["--end", f"127.0.0.1:{self.end.getsockname()[1]}"]
        command += ["--listen", f"127.0.0.1:{self.listen[1]}", "--route", str(self.route)]
        with self.log.open("w") as log:
            words = [*command, "--metrics", self.metrics]
            self.process = subprocess.Popen(words, cwd=ROOT, stderr=log)
        self._open = True
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def ready(self) -> Pod:
        until(lambda: self.route.exists() or self.process.poll() is not None)
        assert self.process.poll() is None, self.log.read_text()
        return self

    def send(self, count: int, period: float = 0.005) -> None:
        for _ in range(count):
            number = len(self.sent_ns)
            data = encode_header(Kind.TELEMETRY, 0, 1, number) + bytes(150)
            self.sent_ns[number] = time.monotonic_ns()
            self.end.sendto(data, self.listen)
            time.sleep(period)

    def delays(self, numbers: range) -> list[float]:
        return [(self.arrived[n] - self.sent_ns[n]) * 1e-9 for n in numbers]

    def page(self, path: str) -> str:
        with urllib.request.urlopen(f"http://{self.metrics}{path}", timeout=5) as answer:
            text: str = answer.read().decode()
            return text

    def close(self) -> None:
        self._open = False
        self._thread.join()
        self.process.kill()
        self.process.wait()
        self.end.close()
        self.peer.close()

    def _receive(self) -> None:
        self.peer.settimeout(0.1)
        while self._open:
            try:
                data = self.peer.recv(512)
            except TimeoutError:
                continue
            self.arrived[int.from_bytes(data[8:16], "little")] = time.monotonic_ns()


@pytest.fixture
def pod(tmp_path: Path) -> Iterator[Callable[..., Pod]]:
    pods: list[Pod] = []

    def make(profile: str, direction: str = "uplink") -> Pod:
        pods.append(Pod(tmp_path, profile, direction))
        return pods[-1]

    yield make
    for one in pods:
        one.close()


def test_it_draws_the_models_delays_in_the_direction_asked(pod: Callable[..., Pod]) -> None:
    link = pod("{uplink: {delay_ms: 5}, downlink: {delay_ms: 60, jitter_ms: 20}}\n", "downlink")
    link.ready().send(100)
    until(lambda: len(link.arrived) == 100)
    seed = load_experiment("paper").seed
    model = LinkDirection(DirectionProfile(0.06, 0.02), seed, uplink=False)
    drawn = [model.send(1, Kind.TELEMETRY, n, 166, 0)[0] * 1e-9 for n in range(100)]
    errors = np.array(link.delays(range(100))) - np.array(drawn)
    assert errors.min() >= 0.0
    assert np.median(errors) < 0.005


@pytest.mark.promise("link-changes-in-flight")
def test_a_change_in_flight_acts_within_1_s_and_loses_nothing(
    pod: Callable[..., Pod],
) -> None:
    link = pod("uplink: {delay_ms: 300}\n").ready()
    link.send(20)
    draft = link.profile.with_name("draft")
    draft.write_text("{description: quick, uplink: {delay_ms: 20}}\n")
    changed_ns = time.monotonic_ns()
    draft.replace(link.profile)
    link.send(240)
    until(lambda: len(link.arrived) == 260)
    delays = link.delays(range(260))
    assert min(delays[:20]) >= 0.3
    first = next(n for n, delay in enumerate(delays) if delay < 0.15)
    assert (link.sent_ns[first] - changed_ns) * 1e-9 < 1.0
    assert np.median(delays[-20:]) == pytest.approx(0.020, abs=0.01)
    state = json.loads(link.route.with_name("link.json").read_text())
    assert state["profile"]["description"] == "quick"


def test_a_change_handed_inside_is_in_force_at_the_commands_end(
    pod: Callable[..., Pod],
) -> None:
    link = pod("uplink: {delay_ms: 300}\n").ready()
    note = json.dumps({"number": "a1", "cause": "by hand", "restart": True})
    files = {"profile.yaml": "uplink: {delay_ms: 20}\n"}
    document = write_handed(Handed(note, files))
    command = ["sh", "-c", APPLY_SCRIPT, "sh", str(link.route.parent), "a1", str(len(document))]
    began = time.monotonic()
    done = subprocess.run(command, input=document, check=True, capture_output=True, text=True)
    print(f"in force after {time.monotonic() - began:.2f} s")
    told = json.loads(done.stdout)
    assert (told["change"], told["cause"], told["asked"]["delay"]) == ("a1", "by hand", 0.02)
    link.send(20)
    until(lambda: len(link.arrived) == 20)
    assert np.median(link.delays(range(20))) == pytest.approx(0.02, abs=0.01)


def test_it_is_ready_counts_and_ends_in_half_a_second(pod: Callable[..., Pod]) -> None:
    link = pod("uplink: {loss: 1.0}\n").ready()
    assert link.page("/readyz") == "ready\n"
    link.end.sendto(b"short", link.listen)
    with bind_loopback() as stranger:
        stranger.sendto(encode_header(Kind.TELEMETRY, 0, 1, 7) + bytes(150), link.listen)
    link.send(10)
    until(lambda: 'outcome="lost"} 10.0' in link.page("/metrics"))
    page = link.page("/metrics")
    assert 'cloudrc_link_info{direction="uplink",mode="relay",shaper="relay"} 1.0' in page
    assert 'cloudrc_link_datagrams_total{outcome="malformed"} 1.0' in page
    assert 'cloudrc_link_datagrams_total{outcome="received"} 11.0' in page
    assert link.route.read_text() == f"127.0.0.1:{link.listen[1]}\n"
    link.process.send_signal(signal.SIGTERM)
    assert until(lambda: link.process.poll() is not None) < 0.5
    assert link.process.returncode == 0, link.log.read_text()
    assert not link.route.exists()
    assert [path.name for path in link.route.parent.iterdir()] == ["link.json"]


def test_the_peer_can_change_in_flight() -> None:
    ends = bind_loopback(), bind_loopback()
    shaper = RelayShaper(
        ("127.0.0.1", 0), LinkDirection(DirectionProfile(0.05), 1, True), lambda data: (3, 1, 0)
    )
    with bind_loopback() as out, ends[0], ends[1]:
        for end in ends:
            end.settimeout(0.0)
            route = shaper.follow_peer(end.getsockname())
            out.sendto(end.getsockname()[1].to_bytes(2, "little"), route)
            until(lambda: shaper.step(0.02) or shaper.counts()["received"] > 0)
            began = time.monotonic()
            while time.monotonic() < began + 0.1:
                shaper.step(0.02)
            assert int.from_bytes(end.recv(9), "little") == end.getsockname()[1]
        shaper.close()
