# SPDX-License-Identifier: Apache-2.0

"""The relay over real sockets on 127.0.0.1: in this process, and as a process."""

import json
import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event, Thread, Timer

import numpy as np
import pytest

from cloudrc.config.shipped import names
from cloudrc.flight.links.under_test import WAYS, measure, run_link
from cloudrc.flight.links.verify import find_experiment
from cloudrc.flight.pod.realtime import free_ports
from cloudrc.link.carry import udp as module
from cloudrc.link.carry.udp import Relay, ask_for_stamps
from cloudrc.link.model import LinkDirection
from cloudrc.link.state import RELEASED_SUFFIX, STATE_FILE
from cloudrc.link.traces import link_profile
from cloudrc.link.verify.judge import Flow, Measurement
from cloudrc.link.verify.probe import FIRST_PROBE, PROBE, ProbeEnd
from cloudrc.results.exposition.table import LINK_OUTCOMES
from cloudrc.wire.tunnel.codec import SIZES
from tests.conftest import wait_until
from tests.link.profiles import profile_of

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 20.0
MS = 1_000_000
PLAIN = profile_of()


def bind_loopback(port=0):
    """Open a UDP socket on 127.0.0.1; port 0 lets the kernel choose."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind(("127.0.0.1", port))
    bound.settimeout(PATIENCE)
    return bound


def peek(data):
    if len(data) != 4:
        raise ValueError("not ours")
    return 3, 1, int.from_bytes(data, "little")


def packet(n):
    return n.to_bytes(4, "little")


class Bench:
    """A relay in a thread, between two sockets."""

    def __init__(self, profile):
        self.near, self.far = bind_loopback(), bind_loopback()
        direction, end = LinkDirection(profile, 1, True), self.near.getsockname()
        self.relay = Relay(("127.0.0.1", 0), direction, peek, end)
        self.route = self.relay.follow_peer(self.far.getsockname())
        self._stop = Event()
        self._thread = Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._stop.is_set():
            self.relay.step(0.05)

    def send(self, data):
        self.near.sendto(data, self.route)

    def close(self):
        self._stop.set()
        self._thread.join(PATIENCE)
        for one in (self.near, self.far, self.relay):
            one.close()


@pytest.fixture
def bench():
    with ExitStack() as opened:
        yield lambda profile=PLAIN: opened.enter_context(closing(Bench(profile)))


def test_a_packet_leaves_when_the_model_says_never_earlier(bench):
    profile = profile_of(0.020, 0.010, corrupt=0.5)
    pair, model = bench(profile), LinkDirection(profile, 1, True)
    errors = []
    for n in range(20):
        sent = time.monotonic_ns()
        pair.send(packet(n))
        assert pair.far.recv(100) == model.corrupted(1, 3, n, packet(n))
        (wanted,) = model.send(1, 3, n, 4, 0)
        errors.append(time.monotonic_ns() - sent - wanted)
    assert min(errors) >= 0
    assert sorted(errors)[10] < 50 * MS
    wait_until(lambda: pair.relay.released().get("released") == 20)
    assert 0 <= pair.relay.counts()["release_error_p99_ns"] < 100 * MS


def test_every_datagram_is_counted_once(bench, monkeypatch):
    monkeypatch.setattr(module, "IN_FLIGHT_MAX", 3)
    pair = bench(profile_of(0.1))
    for data in (b"", b"xyz", bytes(1400), bytes(5000)):
        pair.send(data)
    for n in range(5):
        pair.send(packet(n))
    # A pause of this process between two readings of its clocks may exchange the packets.
    assert {pair.far.recv(100) for _ in range(3)} == {packet(n) for n in range(3)}
    pair.relay.follow_profile(profile_of(loss=1.0))
    pair.send(packet(1))
    counts = {"received": 10, "malformed": 4, "overflow": 2, "lost": 1, "forwarded": 3}
    expected = {**dict.fromkeys(LINK_OUTCOMES, 0), **counts}
    wait_until(lambda: expected.items() <= pair.relay.counts().items())


def test_a_stranger_does_not_reach_the_peer(bench):
    pair = bench(profile_of(duplicate=1.0))
    with bind_loopback() as stranger:
        stranger.sendto(packet(7), pair.route)
    pair.send(packet(1))
    assert [pair.far.recv(100) for _ in range(2)] == [packet(1)] * 2
    wait_until(lambda: pair.relay.counts()["forwarded"] == 2)
    assert pair.relay.counts()["received"] == 1


def counted(relay, *outcomes):
    counts = relay.counts()
    return sum(counts[outcome] for outcome in outcomes)


def test_the_peer_can_restart_and_can_change_in_flight(bench):
    pair = bench()
    address = pair.far.getsockname()
    pair.far.close()
    for n in range(3):
        pair.send(packet(n))
    wait_until(lambda: counted(pair.relay, "forwarded", "unsent") == 3)
    pair.far = bind_loopback(address[1])
    pair.send(packet(3))
    assert pair.far.recv(100) == packet(3)
    with bind_loopback() as other:
        pair.relay.follow_peer(other.getsockname())
        pair.send(packet(4))
        assert other.recv(100) == packet(4)


def carried(experiment, duration, rate):
    """Send probes over a link; return what was measured, what was drawn, and the relays' counts."""
    # Half a period away from the instants at which schedules change: a probe takes time.
    sent = FIRST_PROBE + (np.arange(round(duration * rate)) + 0.5) / rate
    plans = {
        way: Measurement(
            link_profile(getattr(experiment, way)),
            Flow(experiment.seed, way == "uplink", PROBE, SIZES[kind]),
            sent,
        )
        for way, (_, _, kind) in WAYS.items()
    }
    with run_link(experiment, "relay") as ways:
        for way, measured in measure(ways, plans).items():
            released = (ways[way].folder / STATE_FILE).with_suffix(RELEASED_SUFFIX)
            yield measured, plans[way].draw(measured.sent), json.loads(released.read_text())


@pytest.mark.process
@pytest.mark.alone
@pytest.mark.promise("link-follows-the-seed")
@pytest.mark.parametrize(
    "profile",
    ["lossy", "lte", *(pytest.param(each, marks=pytest.mark.full) for each in names("profile"))],
)
def test_a_relay_draws_the_virtual_sequence(profile):
    """`lossy` has bursts, `lte` a rate and kept order."""
    for measured, drawn, _ in carried(find_experiment(profile, []), 2.0, 100.0):
        both = np.isfinite(measured.delays) & np.isfinite(drawn.delays)
        arrived, due = ((one.sent + one.delays)[both] for one in (measured, drawn))
        assert (measured.copies == drawn.copies).all()
        assert (arrived - due).min() >= 0.0
        assert np.median(arrived - due) < 5e-3
        assert (np.diff(due[np.argsort(arrived)]) < -5e-6).mean() <= 0.01


@pytest.mark.process
@pytest.mark.alone
@pytest.mark.full
def test_packets_leave_on_time_at_1_khz():
    experiment = find_experiment("ideal", [f"link.{way}.delay_ms=20" for way in WAYS])
    found = [next(carried(experiment, 20.0, 1000.0))[2] for _ in range(5)]
    p50, p99 = (np.median([one[f"release_error_{q}_ns"] for one in found]) for q in ("p50", "p99"))
    assert (p50 <= 60_000, p99 <= 400_000) == (True, True), (p50, p99)
    assert sum(one["released_early"] for one in found) == 0


@pytest.mark.process
@pytest.mark.alone
@pytest.mark.promise("link-changes-in-flight")
def test_a_change_in_flight_acts_within_1_s_and_loses_nothing(tmp_path):
    profile, draft = tmp_path / "profile.yaml", tmp_path / "draft"
    profile.write_text("uplink: {delay_ms: 300, jitter_ms: 50}\n")
    draft.write_text("{description: quick, uplink: {delay_ms: 20}}\n")
    (folder := tmp_path / "run").mkdir()
    end, listen, peer = (("127.0.0.1", port) for port in free_ports(3))
    words = ["link", "run", "--config=paper", f"--profile={profile}", "--direction=uplink"]
    words += [f"--peer=localhost:{peer[1]}", f"--end=127.0.0.1:{end[1]}"]
    words += [f"--listen=127.0.0.1:{listen[1]}", f"--route={folder / 'route'}", "--mode"]
    bare = ["setpriv", "--bounding-set=-net_admin", "--inh-caps=-net_admin"]
    command = [*(bare if os.geteuid() == 0 else []), sys.executable, "-m", "cloudrc", *words]
    with subprocess.Popen([*command, "auto"], cwd=ROOT) as process, ExitStack() as killer:
        killer.callback(process.kill)  # where this test fails, the process ends, too
        wait_until((folder / "route").exists)
        Timer(0.2, draft.replace, [profile]).start()
        plan = Measurement(PLAIN, Flow(1, True, PROBE, 204), np.zeros(300))
        with bind_loopback(end[1]) as own, bind_loopback(peer[1]) as far:
            sender = ProbeEnd(own, listen, plan, time.time_ns())
            ask_for_stamps(far)
            far.settimeout(0.005)
            for n in range(300):
                sender.send(n)
                sender.receive(far)  # waits for 5 ms if nothing arrives
            wait_until(lambda: sender.receive(far) or sender.stream().copies.all())
        stream = sender.stream()
        assert stream.copies.tolist() == [1] * 300
        assert stream.delays[:20].min() >= 0.250
        assert stream.sent[np.flatnonzero(stream.delays < 0.150)[0]] < 1.2
        assert np.median(stream.delays[280:]) < 0.030
        state = json.loads((folder / "link.json").read_text())
        assert state["profile"]["description"] == "quick"
        assert (state["shaper"], state["mode"]) == ("relay", "auto")
        assert state["reason"].startswith("netem does not work here: tc may not change the network")
        process.terminate()
        assert wait_until(lambda: process.poll() is not None) < 0.5
        assert process.returncode == 0
    assert [path.name for path in folder.iterdir()] == ["link.json"]
