"""Teleop and cloud over Unix sockets: nothing blocks, and either may restart."""

import threading
import time

import pytest

from cloudrc.drivers.teleop import (
    BLIND_WAKES,
    EVENTS_KEPT,
    STALL_NS,
    RemoteTeleop,
    UnixPeer,
    serve_teleop,
    turn,
)
from cloudrc.errors import BadInputError
from cloudrc.messages import OperatorRequest, Request, Setpoint
from cloudrc.records import Fault, MissionEvent
from cloudrc.teleop.wire import decode, encode

SECOND = 1_000_000_000
POINT, PAST = Setpoint((1.0, 2.0, 3.0)), Setpoint((0.0, 0.0, 3.0))


def event(number):
    return MissionEvent(number, "reached", number, "there")


def test_a_full_socket_drops_and_never_blocks(peers):
    one, other = peers
    for number in range(5000):
        one.send(b"%d" % number)
    assert one.unsent > 0
    assert other.receive()[0] == b"0"


def test_all_that_systemd_lets_wait_is_taken_in_one_wake(peers, monkeypatch):
    waiting = [b"past"] * 513

    class Inbox:
        def recv(self, size):
            if waiting:
                return waiting.pop()
            raise BlockingIOError

    with monkeypatch.context() as patch:
        patch.setattr(peers[0], "_socket", Inbox())
        assert len(peers[0].receive()) == 513


def test_a_neighbour_that_is_away_or_new_is_no_error(peers, tmp_path):
    one, other = peers
    other.close()
    assert not one.send(b"lost")
    again = UnixPeer(tmp_path / "b.sock", tmp_path / "a.sock")
    assert one.send(b"found")
    assert again.receive() == [b"found"]
    again.close()


def test_a_path_that_is_too_long_is_named(tmp_path):
    with pytest.raises(BadInputError, match="longer than 107 bytes"):
        UnixPeer(tmp_path / ("x" * 120), tmp_path / "b")


def remote(peer):
    return RemoteTeleop(peer, encode, decode, 0)


def test_cloud_reports_each_silence_of_teleop_once(peers):
    one, other = peers
    teleop = remote(one)
    for now_ns in range(0, 3 * SECOND, 10_000_000):
        teleop.handle_deadline(now_ns)
    (fault,) = teleop.take_outputs()
    assert (type(fault), fault.code) == (Fault, "teleop_silent")
    assert "last setpoint is kept" in fault.text
    other.send(encode(POINT))
    for now_ns in range(3 * SECOND, 6 * SECOND, 10_000_000):
        teleop.handle_deadline(now_ns)
    assert [type(output) for output in teleop.take_outputs()] == [Setpoint, Fault]


def test_teleop_is_told_of_every_second_telemetry(peers):
    one, other = peers
    teleop = remote(one)
    for number in range(10):
        teleop.see(POINT._replace(waypoint=number), 10_000_000 * number)
    assert [decode(data).waypoint for data in other.receive()] == [0, 2, 4, 6, 8]


def request(number, what):
    return OperatorRequest(number, what, mission_id=7)


@pytest.mark.parametrize("stalled", [False, True])
def test_after_a_stall_cloud_forwards_stops_but_not_waypoints(peers, stalled):
    """The withdrawal was lost at a full socket."""
    one, other = peers
    teleop = RemoteTeleop(one, encode, decode, SECOND)
    words = [request(n, each) for n, each in enumerate(Request, 1)]
    words += [POINT, POINT._replace(waypoint=0), event(0)]
    for said in words:
        other.send(encode(said))
    teleop.handle_deadline(SECOND + STALL_NS + stalled)
    leads = [words[0], words[-2]] if stalled else []
    assert teleop.take_outputs() == [said for said in words if said not in leads]
    other.send(encode(words[0]))  # the repeat must pass, even to a cloud that is always late
    teleop.handle_deadline(3 * SECOND if stalled else SECOND + STALL_NS + 10_000_000)
    assert teleop.take_outputs() == words[:1]


def test_what_is_no_message_is_counted(peers):
    one, other = peers
    teleop = remote(one)
    other.send(b"rubbish")
    other.send(encode(POINT))
    teleop.handle_deadline(0)
    assert teleop.take_outputs() == [POINT]
    assert teleop.malformed == 1


class Machine:
    """A machine with given outputs that stores the states it sees."""

    def __init__(self):
        self.outputs, self.seen, self.deadlines = [], [], 0

    def hear(self, now_ns):
        self.heard_ns = now_ns

    def see(self, seen, now_ns):
        self.seen.append(seen)

    def handle_deadline(self, now_ns):
        self.deadlines += 1

    def take_outputs(self):
        outputs, self.outputs = self.outputs, []
        return outputs


class Service:
    """Run `serve_teleop` on a thread."""

    def __init__(self, peer):
        self.machine, self.told, self.calls = Machine(), [], []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(peer,))
        self._thread.start()

    def _run(self, peer):
        how = {"calls": self._take, "tell": self.told.extend, "stop": self._stop.is_set}
        serve_teleop(self.machine, peer, encode, decode, **how)

    def _take(self):
        calls, self.calls = self.calls, []
        return calls

    def stop(self):
        self._stop.set()
        self._thread.join(1.0)
        assert not self._thread.is_alive()


def until(condition):
    limit = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.005)


@pytest.fixture
def service(peers):
    running = Service(peers[0])
    yield running
    running.stop()


def test_deadlines_calls_and_messages_meet_in_one_loop(peers, service):
    instants = []
    service.calls = [instants.append]
    peers[1].send(b"rubbish")
    peers[1].send(encode(POINT))
    until(lambda: service.machine.deadlines > 3 and service.machine.seen and instants)
    assert service.machine.seen == [POINT]


def serve(machine, peer, wakes, calls=list):
    """Run the loop for a number of wakes."""
    stops = iter([False] * wakes + [True])
    how = {"calls": calls, "tell": lambda told: None, "stop": lambda: next(stops)}
    serve_teleop(machine, peer, encode, decode, **how)


def test_what_is_asked_for_comes_before_the_newest_that_has_arrived(peers):
    """The emergency stop is made before the state that shows its effect."""
    machine, newest = Machine(), Setpoint((3.0, 2.0, 1.0))
    for data in (encode(POINT), encode(newest), b"rubbish"):
        peers[1].send(data)
    serve(machine, peers[0], 1, lambda: [lambda now_ns: machine.seen.append("asked")])
    assert (machine.seen, machine.deadlines) == (["asked", newest], 1)


@pytest.mark.parametrize(
    ("wakes", "done"),
    [
        ("-", ["asked", PAST]),
        ("sp", [POINT, "asked"]),
        ("s--p", [POINT, "asked"]),
        ("s" + "-" * (BLIND_WAKES - 1), []),
        ("s" + "-" * BLIND_WAKES, ["asked"]),
        ("ss", [PAST, "asked"]),
    ],
)
def test_after_a_stall_old_states_are_skipped_before_calls(peers, monkeypatch, wakes, done):
    """A call may depend on the robot's place, and the socket has only old states.

    At each wake a new state has arrived (p), or the wake follows a stall (s) with an old one.
    """
    machine, clock = Machine(), [SECOND]
    coming = iter(wakes)
    calls = [[lambda now_ns: machine.seen.append("asked")]]
    if wakes == "-":
        peers[1].send(encode(PAST))

    def sleep(seconds):
        what = next(coming)
        clock[0] += round(seconds * 1e9) + (2 * STALL_NS if what == "s" else 0)
        if what in "sp":
            peers[1].send(encode(PAST if what == "s" else POINT))

    monkeypatch.setattr("cloudrc.drivers.teleop.time.sleep", sleep)
    monkeypatch.setattr("cloudrc.drivers.teleop.time.monotonic_ns", lambda: clock[0])
    serve(machine, peers[0], len(wakes), lambda: calls.pop() if calls else [])
    assert machine.seen == done


def test_events_wait_for_an_absent_cloud_bounded_and_in_order(peers, service, tmp_path):
    _, cloud = peers
    cloud.close()
    (tmp_path / "b.sock").unlink()
    events = [event(number) for number in range(EVENTS_KEPT + 50)]
    service.machine.outputs = [POINT, *events, Fault(0, "journal", "full")]
    until(lambda: len(service.told) == len(events) + 1)
    back = UnixPeer(tmp_path / "b.sock", tmp_path / "a.sock")
    received = []
    until(lambda: received.extend(map(decode, back.receive())) or len(received) >= EVENTS_KEPT)
    assert received == events[50:]  # setpoints are repeated anyway; faults are not for cloud
    back.close()


def told(cloud, teleop, seconds, telemetry):
    """Return what cloud sends in `seconds` [s] after the end of its telemetry."""
    cloud, received = remote(cloud), []
    for now_ns in range(0, round(seconds * 1e9), 10_000_000):
        if now_ns < telemetry * 1e9:
            cloud.see(POINT, now_ns)
        cloud.handle_deadline(now_ns)
        received += teleop.receive()
    return received


def test_without_telemetry_cloud_signals_life_5_times_a_second(peers):
    assert told(*peers, seconds=1.0, telemetry=0.0) == [b""] * 5
    received = told(*peers, seconds=2.0, telemetry=1.0)
    assert b"" not in received[:50]
    assert 4 <= received.count(b"") <= 5


def test_teleop_hears_of_cloud_whatever_it_says_but_after_a_stall(peers):
    cloud, teleop = peers
    machine, heard = Machine(), []

    def wake(now_ns, *, data=None, blind=0, late_ns=0):
        if data is not None:
            cloud.send(data)
        how = {"blind": blind, "late_ns": late_ns, "now_ns": now_ns}
        return turn(machine, teleop, decode, list, **how)

    machine.hear = heard.append
    for now_ns, data in enumerate((None, b"", b"rubbish", encode(POINT))):
        wake(now_ns, data=data)
    assert (heard, machine.seen) == ([1, 2, 3], [POINT])
    assert wake(4, data=b"", late_ns=STALL_NS + 1) == BLIND_WAKES
    assert wake(5, data=b"", blind=BLIND_WAKES) == BLIND_WAKES - 1
    assert wake(6, data=encode(POINT), blind=BLIND_WAKES - 1) == 0
    assert (heard, machine.seen) == ([1, 2, 3, 6], [POINT, POINT])
