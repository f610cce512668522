# SPDX-License-Identifier: Apache-2.0

"""Teleop and cloud over Unix sockets: nothing blocks, and either may restart."""

import threading
import time
from itertools import chain, repeat
from unittest.mock import Mock

import pytest

from cloudrc.flight.pod.teleop_link import (
    BLIND_WAKES,
    EVENTS_KEPT,
    STALL_NS,
    RemoteTeleop,
    TeleopLoop,
    UnixPeer,
)
from cloudrc.teleop.wire import RobotStatus
from cloudrc.wire.messages import GuardState, OperatorRequest, Request, Setpoint
from cloudrc.wire.records import Fault, MissionEvent

SECOND, PERIOD_NS = 1_000_000_000, 10_000_000
POINT = Setpoint((1.0, 2.0, 3.0))
KNOWN = {"touch_speed": 0.0, "uplink_delay": 0.0}  # not NaN, so that equal statuses compare equal
NOW, OLD = (RobotStatus(1, (x, 0.0, 1.0), GuardState.TRACK, 0, **KNOWN) for x in (1.0, 0.0))


def event(number):
    return MissionEvent(number, "reached", number, "there")


# Sockets


def test_a_full_socket_drops_and_never_blocks(peers):
    one, other = peers
    assert not all([one.send(event(number)) for number in range(5000)])
    assert other.receive()[0] == event(0)


# Cloud's side


def test_cloud_reports_each_silence_of_teleop_once(peers):
    one, other = peers
    teleop = RemoteTeleop(one, 0)
    for now_ns in range(0, 3 * SECOND, PERIOD_NS):
        teleop.handle_deadline(now_ns)
    assert teleop.take_outputs() == [], "without telemetry teleop has nothing to say"
    teleop.see(NOW, 3 * SECOND)
    for now_ns in range(3 * SECOND, 6 * SECOND, PERIOD_NS):
        teleop.handle_deadline(now_ns)
    (fault,) = teleop.take_outputs()
    assert (type(fault), fault.code) == (Fault, "teleop_silent")
    other.send(None)  # a sign of life
    other.send(POINT)
    for now_ns in range(6 * SECOND, 9 * SECOND, PERIOD_NS):
        teleop.handle_deadline(now_ns)
    assert [type(output) for output in teleop.take_outputs()] == [Setpoint, Fault]


@pytest.mark.parametrize("stalled", [False, True])
def test_after_a_stall_cloud_forwards_stops_but_not_waypoints(peers, stalled):
    """Teleop may have withdrawn the waypoints in a datagram that a full socket refused."""
    one, other = peers
    teleop = RemoteTeleop(one, SECOND)
    words = [OperatorRequest(n, each, mission_id=7) for n, each in enumerate(Request, 1)]
    words += [POINT, POINT._replace(waypoint=0), event(0)]
    for said in words:
        other.send(said)
    teleop.handle_deadline(SECOND + STALL_NS + stalled)
    leads = [words[0], words[-2]] if stalled else []
    assert teleop.take_outputs() == [said for said in words if said not in leads]
    other.send(words[0])  # the repeat must pass, even to a cloud that is always late
    teleop.handle_deadline(3 * SECOND if stalled else SECOND + STALL_NS + PERIOD_NS)
    assert teleop.take_outputs() == words[:1]


# Teleop's side


def a_machine(*outputs):
    """Make a machine with given outputs."""
    return Mock(take_outputs=Mock(side_effect=chain([list(outputs)], repeat([]))))


def serve(machine, peer, wakes, calls=lambda now_ns: None, told=None):
    """Serve for so many wakes."""
    left, tell = iter(range(wakes)), [].extend if told is None else told.extend
    TeleopLoop(machine, peer, tell, calls=calls).run(lambda: next(left, None) is None)


@pytest.mark.parametrize(
    ("wakes", "done"),
    [
        ("s--p", [NOW, "asked"]),
        ("s" + "-" * (BLIND_WAKES - 1), []),
        ("s" + "-" * BLIND_WAKES, ["asked"]),
        ("ss", [OLD, "asked"]),
    ],
)
def test_after_a_stall_old_states_are_skipped_before_calls(peers, monkeypatch, wakes, done):
    """A call may depend on the robot's place, and the socket has only old states.

    At each wake a new state has arrived (p), or the wake follows a stall (s) with an old one.
    """
    machine, clock, coming = a_machine(), [SECOND], iter(wakes)
    calls, done_so_far = ["asked"], []
    machine.see = lambda seen, now_ns: done_so_far.append(seen)

    def sleep(seconds):
        what = next(coming)
        clock[0] += round(seconds * 1e9) + (2 * STALL_NS if what == "s" else 0)
        if what in "sp":
            peers[1].send(OLD if what == "s" else NOW)

    monkeypatch.setattr("cloudrc.flight.pod.teleop_link.time.sleep", sleep)
    monkeypatch.setattr("cloudrc.flight.pod.teleop_link.time.monotonic_ns", lambda: clock[0])
    serve(machine, peers[0], len(wakes), lambda now_ns: calls and done_so_far.append(calls.pop()))
    assert done_so_far == done
    assert machine.hear.called == bool({NOW, OLD} & set(done)), "old signs of life do not count"


def test_events_wait_for_an_absent_cloud_in_order_and_bounded(peers, tmp_path):
    teleop, cloud = peers
    cloud.close()
    (tmp_path / "b.sock").unlink()
    events = [event(number) for number in range(EVENTS_KEPT + 50)]
    machine, told = a_machine(POINT, *events, Fault(0, "journal", "full")), []
    server = threading.Thread(target=serve, args=(machine, teleop, 40), kwargs={"told": told})
    server.start()
    received, back, limit = [], None, time.monotonic() + 5.0
    while len(received) < EVENTS_KEPT:
        assert time.monotonic() < limit
        if len(told) > len(events):
            back = back or UnixPeer(tmp_path / "b.sock", tmp_path / "a.sock")
            received += back.receive()
        time.sleep(0.005)
    server.join()
    back.close()
    assert received == events[50:]  # setpoints are repeated anyway; faults are not for cloud
