"""Teleop distinguishes a silent robot from a silent cloud by cloud's empty datagrams."""

from __future__ import annotations

from cloudrc.drivers.teleop import ALIVE_NS, BLIND_WAKES, STALL_NS, RemoteTeleop, UnixPeer, turn
from cloudrc.messages import Setpoint
from cloudrc.teleop.wire import decode, encode

PERIOD_NS = 10_000_000
SECOND = 1_000_000_000
POINT = Setpoint((1.0, 2.0, 3.0))
Peers = tuple[UnixPeer, UnixPeer]


class Machine:
    """Stores when cloud was heard and which states were seen."""

    def __init__(self) -> None:
        self.heard: list[int] = []
        self.seen: list[object] = []

    def hear(self, now_ns: int) -> None:
        self.heard.append(now_ns)

    def see(self, seen: object, now_ns: int) -> None:
        self.seen.append(seen)

    def handle_deadline(self, now_ns: int) -> None:
        pass

    def take_outputs(self) -> list[object]:
        return []


def wake(machine: Machine, peer: UnixPeer, now_ns: int, *, blind: int = 0, late_ns: int = 0) -> int:
    return turn(machine, peer, decode, list, blind=blind, late_ns=late_ns, now_ns=now_ns)


def told(cloud: UnixPeer, teleop: UnixPeer, seconds: float, telemetry: float) -> list[bytes]:
    """Return what cloud sends in `seconds` [s] after the end of its telemetry."""
    remote, received = RemoteTeleop(cloud, encode, decode, 0), list[bytes]()
    for now_ns in range(0, round(seconds * 1e9), PERIOD_NS):
        if now_ns < telemetry * 1e9:
            remote.see(POINT, now_ns)
        remote.handle_deadline(now_ns)
        received += teleop.receive()
    return received


def test_without_telemetry_cloud_signals_life_5_times_a_second(
    peers: Peers,
) -> None:
    assert told(*peers, seconds=1.0, telemetry=0.0) == [b""] * 5


def test_telemetry_says_it_and_nothing_else_is_said_beside_it(peers: Peers) -> None:
    received = told(*peers, seconds=2.0, telemetry=1.0)
    assert b"" not in received[:50]
    assert 4 <= received.count(b"") <= 5
    assert ALIVE_NS == 200_000_000


def test_teleop_hears_of_cloud_whatever_it_says(peers: Peers) -> None:
    cloud, teleop = peers
    machine = Machine()
    for now_ns, data in enumerate((b"", b"rubbish", encode(POINT))):
        wake(machine, teleop, 100 + now_ns)
        cloud.send(data)
        wake(machine, teleop, now_ns)
    assert machine.heard == [0, 1, 2]
    assert machine.seen == [POINT]


def test_after_a_stall_teleop_waits_and_ignores_old_signals(
    peers: Peers,
) -> None:
    cloud, teleop = peers
    machine = Machine()
    cloud.send(b"")
    assert wake(machine, teleop, SECOND, late_ns=STALL_NS + 1) == BLIND_WAKES
    assert machine.heard == []
    cloud.send(b"")
    assert wake(machine, teleop, 2 * SECOND, blind=BLIND_WAKES) == BLIND_WAKES - 1
    cloud.send(encode(POINT))
    assert wake(machine, teleop, 3 * SECOND, blind=BLIND_WAKES - 1) == 0
    assert (machine.heard, machine.seen) == ([3 * SECOND], [POINT])
