# SPDX-License-Identifier: Apache-2.0

"""netem of the kernel, measured between two network namespaces."""

import os
import socket
import struct
import subprocess
import threading
import time
from contextlib import suppress
from itertools import pairwise

import numpy as np
import pytest

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.config.profile import load_profile
from cloudrc.config.shipped import names
from cloudrc.flight.links.under_test import DEVICE, HOSTS, _namespaces, inside
from cloudrc.flight.pod.netem_tools import Programs
from cloudrc.link.model import LinkDirection
from cloudrc.link.netem import STRETCH, Netem, table
from cloudrc.link.profile import Trace
from cloudrc.link.streams import numbers, sample
from cloudrc.link.traces import link_profile
from cloudrc.wire.tunnel.codec import Kind
from tests.link.profiles import blackout, changed, in_bursts, profile_of

MINUTES = [
    (name, way)
    for name in names("profile")
    for way in ("uplink", "downlink")
    if name != "lossy"
    and "-sa" not in name  # netem refuses these
    and (way == "uplink" or load_profile(name).downlink != load_profile(name).uplink)
]
"""Directions of the shipped profiles; one direction if both are equal."""
pytestmark = pytest.mark.netem


NEAR, FAR = (f"cloudrc-{way}-{os.getpid()}" for way in HOSTS)
FAR_PEER = FAR_HOST, _ = HOSTS["downlink"], 7400
WITHIN = 0.002
"""Tolerance of medians [s]; means are worse, because a slow virtual machine stalls."""
LATE = 0.1
"""Accepted lateness of a change, because a virtual machine stalls [s]."""
SIZE = 172
_SO_TIMESTAMPNS = 35  # include/uapi/asm-generic/socket.h


def sh(*words):
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


class NearPrograms(Programs):
    """Runs tc and ip in the near namespace."""

    def __call__(self, words):
        with inside(NEAR):
            return super().__call__(words)


def qdiscs():
    return sh("tc", "-n", NEAR, "qdisc", "show", "dev", DEVICE)


class Flow:
    """Numbered datagrams from the near namespace to a port of the far one, and their arrivals."""

    def __init__(self, port=7400):
        self.port, self.sent_ns, self.arrived = port, [], []
        with inside(NEAR):
            self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with inside(FAR):
            self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._in.bind((FAR_HOST, port))
        self._in.settimeout(0.1)
        self._in.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)  # the kernel's time of arrival
        self._open = True
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def send(self, count, period=0.01, meanwhile=int):
        """Send `count` datagrams, one per period; call `meanwhile` after each."""
        begin = time.monotonic()
        for index in range(count):
            number = len(self.sent_ns)
            self.sent_ns.append(time.time_ns())
            self._out.sendto(number.to_bytes(4, "little") + bytes(168), (FAR_HOST, self.port))
            meanwhile()
            time.sleep(max(0.0, begin + (index + 1) * period - time.monotonic()))

    def settle(self):
        """Wait until nothing arrives any more, then close."""
        count = -1
        while count != len(self.arrived):
            count = len(self.arrived)
            time.sleep(0.5)
        self._open = False
        self._thread.join()
        self._out.close()
        self._in.close()
        return self

    def delays(self):
        """Return the one-way delay of each copy that arrived [s]."""
        return np.array([(at_ns - self.sent_ns[n]) * 1e-9 for n, at_ns in self.arrived])

    def numbers(self):
        return [number for number, _ in self.arrived]

    def _receive(self):
        while self._open:
            with suppress(TimeoutError):
                data, notes, _, _ = self._in.recvmsg(512, 64)
                seconds, rest_ns = struct.unpack("=qq", notes[0][2])
                number = int.from_bytes(data[:4], "little")
                self.arrived.append((number, seconds * 1_000_000_000 + rest_ns))


def measure(count, period=0.01):
    """Send a flow and wait for its end."""
    flow = Flow()
    flow.send(count, period)
    return flow.settle()


def least(error, enough):
    """Return the smallest of up to three errors, since a stall of the machine spoils one."""
    found = error()
    for _ in range(2):
        found = found if found < enough else min(found, error())
    return found


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Connect two namespaces; return a function that makes a netem in the near one."""
    folder = tmp_path_factory.mktemp("tc")
    run = NearPrograms(str(folder))

    def made(profile, origin_ns=0):
        ways = {"clock": time.monotonic_ns, "wait": time.sleep, "tables": folder, "log": print}
        return Netem(run, profile, origin_ns=origin_ns, **ways)

    try:
        with _namespaces():
            for verb in ("add", "del"):
                sh("tc", "-n", NEAR, "qdisc", verb, "dev", DEVICE, "root", "netem")
            yield made
            run.close()
    except (MissingPrerequisiteError, subprocess.CalledProcessError) as error:
        pytest.exit(f"netem cannot be tested here: {error}", MissingPrerequisiteError.exit_code)


@pytest.fixture
def shaped(make):
    """Install netem without conditions."""
    netem = make(profile_of())
    assert netem.follow_peer(FAR_PEER) == FAR_PEER
    yield netem
    netem.close()


@pytest.mark.smoke
def test_the_delay_is_applied_to_the_tunnels_flow_alone(shaped):
    shaped.follow_profile(profile_of(delay=0.060))

    def off():
        tunnel, stranger = Flow(), Flow(port=7402)
        tunnel.send(200, meanwhile=lambda: stranger.send(1, 0.0))
        delay, other = np.median(tunnel.settle().delays()), np.median(stranger.settle().delays())
        assert other < 0.020
        return float(abs(delay - other - 0.060))

    assert least(off, WITHIN) < WITHIN


@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto", "table"])
def test_jitter_is_distributed_as_asked(shaped, distribution):
    drawn = np.sort(np.random.default_rng(5).gamma(2.0, size=2000))
    measured = (drawn - drawn.mean()) / drawn.std()
    profile = profile_of(0.080, 0.020, distribution, quantiles=tuple(measured.tolist()))
    shaped.follow_profile(changed(profile, distribution="normal"))
    shaped.follow_profile(profile)
    shares = [0.05, 0.25, 0.5, 0.75, 0.95]
    if distribution != "table":
        measured = np.array(table(profile)) * STRETCH[distribution] / 8192
    asked = 0.080 + 0.020 * np.quantile(measured, shares)

    def off():
        delays = measure(800, 0.004).delays()
        return float(np.abs(np.quantile(delays, shares) - asked).max())

    assert least(off, 0.006) < 0.006


@pytest.mark.parametrize(
    ("asked", "share", "burst"), [(0.2, 0.2, 1.25), (in_bursts(0.05, 0.25), 1 / 6, 4.0)]
)
def test_losses_are_as_many_as_asked_and_counted(shaped, asked, share, burst):
    shaped.follow_profile(profile_of(loss=asked))
    arrived, counts = set(measure(2000, 0.002).numbers()), shaped.counts()
    lost = [n for n in range(2000) if n not in arrived]
    mean = len(lost) / (1 + sum(after - before > 1 for before, after in pairwise(lost)))
    assert (counts["forwarded"], counts["lost"]) == (len(arrived), len(lost))
    assert len(lost) / 2000 == pytest.approx(share, abs=0.07)
    assert mean == pytest.approx(burst, rel=0.5)


@pytest.mark.full
@pytest.mark.parametrize(("name", "way"), MINUTES)
def test_a_shipped_profile_for_a_minute(shaped, name, way):
    """Mean, loss and order are those that the model draws for the same instants of sending."""
    profile = link_profile(getattr(load_profile(name), way))
    found, drawn = [], []

    def off():
        tunnel, stranger = Flow(), Flow(port=7402)
        sending = (6000, 0.01, lambda: stranger.send(1, 0.0))
        sender = threading.Thread(target=tunnel.send, args=sending)
        shaped.follow_profile(profile, restart=True)
        sender.start()
        while sender.is_alive():
            shaped.step(0.1)  # as a link's process does, whether there is a schedule or not
        found[:] = [tunnel.settle()]
        drawn[:] = [drawn_for(tunnel, profile, seed) for seed in range(20)]
        beside, mean = stranger.settle().delays().mean(), tunnel.delays().mean()
        asked = float(np.mean([each.mean for each in drawn]))
        return float(abs(mean - beside - asked))

    error = least(off, WITHIN)
    assert error <= WITHIN
    order = np.array(found[0].numbers())
    loss = 1 - len(set(found[0].numbers())) / 6000
    overtaken = float(np.sum(np.maximum.accumulate(order)[:-1] > order[1:])) / len(order)
    for what, measured in (("loss", loss), ("overtaken", overtaken)):
        values = np.array([getattr(each, what) for each in drawn])
        assert abs(measured - values.mean()) <= 5 * values.std() + 0.003, what


def drawn_for(flow, profile, seed):
    """Return the model's statistics for packets with the times of sending of a flow."""
    sent_ns = [at_ns - flow.sent_ns[0] for at_ns in flow.sent_ns]
    return numbers(sample(LinkDirection(profile, seed, True), Kind.TELEMETRY, sent_ns, SIZE))


def test_a_change_in_flight_loses_nothing(shaped):
    asked = [profile_of(delay) for delay in (0.3, 0.02, 0.15, 0.05, 0.2)]
    asked[1] = changed(asked[1], rate=1e6, queue_packets=5)  # less room than what is under way
    asked[2] = changed(asked[2], jitter=0.02, distribution="normal")
    asked[3] = changed(asked[3], rate=2e6)
    flow = Flow()
    for profile in asked:
        flow.send(60, 0.005)
        shaped.follow_profile(profile)
    flow.send(60, 0.005)
    assert sorted(flow.settle().numbers()) == list(range(360))
    assert flow.delays()[:30].max() < 0.050
    assert np.median(flow.delays()[-30:]) == pytest.approx(0.2, abs=0.010)
    assert shaped.counts()["lost"] == 0


def test_a_bottleneck_has_its_rate(shaped):
    shaped.follow_profile(profile_of(rate=400e3, queue_packets=1000))

    def off():
        (flow := Flow()).send(100, 0.0)
        flow.settle()
        took = (flow.arrived[-1][1] - flow.arrived[0][1]) * 1e-9
        return abs(99 * 200 * 8 / took / 400e3 - 1.0)  # 172 bytes and 28 of headers

    assert least(off, 0.03) < 0.03


def test_it_is_set_up_once_and_removed_without_a_trace(make):
    before = qdiscs()
    first = make(profile_of(0.02))
    first.follow_peer(("10.79.7.9", 7400))  # killed here: its qdiscs stay
    left = qdiscs()
    second = make(profile_of(0.05))
    for peer in (FAR_PEER, FAR_PEER, ("10.79.7.7", 7400), FAR_PEER):
        second.follow_peer(peer)
    assert qdiscs().count("netem") == left.count("netem") == 1
    filters = sh("tc", "-n", NEAR, "filter", "show", "dev", DEVICE, "parent", "7400:")
    assert filters.count("flowid 7400:4") == 1
    assert np.median(measure(50).delays()) == pytest.approx(0.05, abs=0.01)
    second.close()
    second.close()
    assert qdiscs() == before


def test_a_schedule_is_followed(make):
    """60 to 140 ms in waves of 4 s, one row per 20 ms; measured at the instants of sending."""
    times = 0.02 * np.arange(400)
    rows = 0.1 + 0.04 * np.sin(0.5 * np.pi * times)
    trace = Trace(tuple(times.tolist()), tuple(rows.tolist()))
    profile = profile_of(rows=trace, blackouts=(blackout(3.51, 0.3),))

    def off():
        origin_ns = time.monotonic_ns() + 5_000_000_000  # by then it is set up
        begun_ns = origin_ns + time.time_ns() - time.monotonic_ns()
        netem, flow = make(profile, origin_ns), Flow()
        netem.follow_peer(FAR_PEER)
        sender = threading.Thread(target=flow.send, args=(700, 0.02))
        sender.start()
        while sender.is_alive():
            netem.step(0.1)
        flow.settle()
        netem.close()
        sent = (np.array(flow.sent_ns) - begun_ns) * 1e-9
        lost, arrived = np.delete(sent, flow.numbers()), sent[flow.numbers()]
        assert (lost.min(), lost.max()) == pytest.approx((3.51, 3.81), abs=LATE)
        on = (arrived > 0.0) & (arrived < times[-1])
        asked = rows[np.searchsorted(times, arrived[on], side="right") - 1]
        return 1.0 - float(np.corrcoef(asked, flow.delays()[on])[0, 1])

    assert least(off, 0.02) < 0.02
