# SPDX-License-Identifier: Apache-2.0

"""The relay between two programs, over sockets in place of TUN devices, and its verdict."""

import socket
from contextlib import ExitStack
from functools import partial
from math import isnan
from types import SimpleNamespace

import pytest

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.link.carry import engine as module
from cloudrc.link.carry import tun
from cloudrc.link.carry.engine import Engine, LinkWay
from cloudrc.link.carry.log import LOST, PacketLog
from cloudrc.link.carry.tun import TunPort, write_packet
from cloudrc.link.exec import namespace
from cloudrc.link.library import KIND
from cloudrc.link.model import LinkDirection
from cloudrc.link.verify.packets import Period, judge_packets, recording
from tests.link.profiles import profile_of

MS = 1_000_000
PACKET = b"\x45" + bytes(99)


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still while the relay waits for packets: 1 us for each reading."""
    time = {"now": 0}

    def read():
        time["now"] += 1_000
        return time["now"]

    for each in (module, tun):
        monkeypatch.setattr(each, "time", SimpleNamespace(monotonic_ns=read))
    return time


def test_a_packet_leaves_when_it_is_due_and_not_before(clock):
    with ExitStack() as opened:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
        for one in (*pairs[0], *pairs[1]):
            one.setblocking(False)
            opened.enter_context(one)
        (client, near), (server, far) = pairs
        write = partial(write_packet, far.fileno())
        way = LinkWay(LinkDirection(profile_of(0.020), 1, True), write)
        engine = Engine(TunPort({near.fileno(): way}), (way,), 3)
        client.send(PACKET)
        engine.step(0.0)
        with pytest.raises(BlockingIOError):
            server.recv(2000)
        clock["now"] += 21 * MS
        engine.step(0.0)
        assert server.recv(2000) == PACKET
    assert way.log.due[0] - way.log.sent[0] == 20 * MS
    assert 0 <= way.log.left[0] - way.log.due[0] < 2 * MS


def log_of(profile, late_ns=0, count=2000, size=100):
    """Make the log of a relay that adds `late_ns` to each packet of a `size` [ns, bytes]."""
    log, model = PacketLog(), LinkDirection(profile, 7, True)
    for number in range(count):
        sent_ns = number * 10 * MS
        arrivals = model.send(1, KIND, number, size - 28, sent_ns)
        log.enter(sent_ns, size, arrivals)
        for due_ns in arrivals:
            log.leave(number, due_ns + late_ns)
    return log


def judged(log, profile, cuts=False):
    """Return what the profile asks of these packets, and the verdicts, by quantity."""
    rows = judge_packets(log, Period(profile, 7, True, 0, 0, cuts))
    return {row.name: value for value, row in rows}, {row.name: row.verdict for _, row in rows}


def test_a_relay_is_verified_unless_it_is_late_or_loses_packets_by_itself():
    profile = profile_of(0.040, 0.010, loss=0.02)
    log = log_of(profile, 20_000)
    asked, verdicts = judged(log, profile)
    assert {*verdicts.values()} == {"ok"}
    assert asked["mean"] == pytest.approx(0.040, abs=5e-4)
    assert asked["loss"] == pytest.approx(0.02, abs=5e-3)
    assert judged(log_of(profile, 5 * MS), profile)[1]["mean"] == "off"
    for number in range(0, 2000, 10):
        log.copies[number] = 0
    assert judged(log, profile)[1]["loss"] == "off"


def test_a_large_packet_is_asked_for_as_a_small_one_and_a_message_in_pieces_is_not():
    profile = profile_of(0.040, 0.010)
    log = log_of(profile, size=1500)
    assert judged(log, profile)[0]["mean"] == pytest.approx(0.040, abs=5e-4)
    assert isnan(judged(log, profile, cuts=True)[0]["mean"])


@pytest.mark.parametrize(
    ("rate", "waits"),
    [
        (100_000.0, 0.008),  # 100 bytes each 10 ms
        (64_000.0, 0.0125 + 0.0025 * 999.5),  # more than the rate: each waits 2.5 ms more
    ],
)
def test_a_limited_rate_asks_for_what_these_packets_would_meet(rate, waits):
    profile = profile_of(0.040, rate=rate, queue_packets=10_000)
    asked, _ = judged(log_of(profile), profile)
    assert asked["mean"] == pytest.approx(0.040 + waits, abs=1e-4)
    assert (asked["loss"], asked["rate"]) == (0.0, rate)


def test_a_recording_is_a_log_that_link_record_reads(tmp_path, call):
    path = tmp_path / "uplink.csv"
    log = log_of(profile_of(0.040, 0.010, loss=0.1), count=500)
    path.write_text("\n".join(recording(log, 0)) + "\n")
    lost = list(log.due).count(LOST) / 500
    said = call(f"link record {path} -o {tmp_path / 'trace.csv'}").out
    assert f"{lost:.3g} lost" in said


def test_a_machine_that_refuses_namespaces_names_the_relay_without_privileges(monkeypatch):
    def refuse(flags):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(namespace, "_unshare", refuse)
    with pytest.raises(MissingPrerequisiteError, match="cloudrc link relay tcp"):
        namespace.enter()
