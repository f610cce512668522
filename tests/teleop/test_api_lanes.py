"""Each role has room of its own in the API: readers cannot take an operator's.

The lane of the emergency stop is an operator's POST and nothing else; what is refused is counted as
well as what is served.
"""

import contextvars
import threading

import pytest

from cloudrc.messages import GuardState
from cloudrc.teleop import api
from cloudrc.teleop import api as api_events
from cloudrc.teleop.bridge import LANE, WAITING_MAX, Bridge
from cloudrc.teleop.server import Limits
from cloudrc.teleop.store import Order, UnavailableError
from tests.teleop.conftest import LIMIT, OPERATOR, READER, SERVICE_PLAN, connect, head, running

STRANGER = "no-token-that-is-known"
TIGHT = Limits(rate_hz=0.001, burst=5, in_flight=2, streams=1)


def statuses(one, count, path, token, method, data=b""):
    """What so many requests, one after the other, are answered with."""
    sent = data if method == "POST" else None
    return [one.send(one.request(path, sent, token, method))[0] for _ in range(count)]


def test_readers_whose_requests_hang_do_not_hold_up_an_operator(monkeypatch):
    """The loop waits for its disk, and 200 readers wait for the loop."""
    with running(limits=Limits()) as one:
        free = threading.Event()
        one.bridge.take = lambda take=one.bridge.take: take() if free.wait(LIMIT) else []
        readers = [connect(one) for _ in range(200)]
        for connection in readers:
            connection.sendall(head("GET", "/v1/state", token=READER))
        one.until(lambda: one.gate._in_flight["reader", "request"] == Limits().in_flight)
        one.until(lambda: one.gate.counts["busy"] == 200 - Limits().in_flight)
        operator = connect(one)
        operator.sendall(head("POST", "/v1/hold", "Content-Length: 0"))
        one.until(lambda: one.gate._in_flight["operator", "request"] == 1)
        free.set()
        assert b" 409 " in operator.recv(4096)  # there is no mission; but the service was asked
        for connection in (*readers, operator):
            connection.close()


def test_streams_of_readers_leave_an_operator_one(monkeypatch):
    monkeypatch.setattr(api_events, "LOOK_PERIOD", 0.01)
    with running(limits=Limits(1e6, 10**6, 64, streams=1)) as one:
        streams = [connect(one) for _ in range(2)]
        for stream, token in zip(streams, (READER, OPERATOR), strict=True):
            stream.sendall(head("GET", "/v1/events", token=token))
            assert b" 200 " in stream.recv(4096)
        assert one.send(one.request("/v1/events", token=READER))[0] == 429
        for stream in streams:
            stream.close()


def test_an_earlier_acknowledgement_does_not_release_a_stop():
    """The stop passes it by while the loop waits for its disk."""
    with running() as one:
        free = threading.Event()
        one.bridge.take = lambda take=one.bridge.take: take() if free.wait(LIMIT) else []
        early, stop = connect(one), connect(one)
        early.sendall(head("POST", "/v1/acknowledge", "Content-Length: 0"))
        one.until(lambda: any(one.bridge._lanes.values()))
        stop.sendall(head("POST", "/v1/estop", "Content-Length: 0"))
        one.until(lambda: one.bridge.stops == 1)
        free.set()
        assert b" 409 " in early.recv(4096)
        assert b" 200 " in stop.recv(4096)
        for connection in (early, stop):
            connection.close()
        assert one.send(one.request("/v1/acknowledge", b"", OPERATOR, "POST"))[0] == 200


def test_each_role_has_its_own_queue_and_operators_come_first():
    bridge, made = Bridge(), []
    bridge.open(object())

    def submit(role, number):
        context = contextvars.copy_context()
        context.run(LANE.set, role)
        return context.run(bridge.submit, lambda service, now_ns: made.append((role, number)))

    readers = [submit("reader", number) for number in range(WAITING_MAX)]
    with pytest.raises(UnavailableError, match="64 requests wait already"):
        submit("reader", WAITING_MAX)
    submit("operator", 0)
    readers[5].cancel()  # its caller has gone: there is room for another
    submit("reader", WAITING_MAX)
    for _ in range(2):
        for call in bridge.take():
            call(0)
    others = [number for number in range(WAITING_MAX + 1) if number != 5]
    assert made == [("operator", 0), *(("reader", number) for number in others)]


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE", "OPTIONS"])
@pytest.mark.parametrize(("token", "left"), [(READER, 5), (OPERATOR, 4), (STRANGER, 5)])
def test_the_emergency_stop_path_does_not_bypass_the_limits(method, token, left):
    """`running` has asked once as the operator."""
    with running(limits=TIGHT) as one:
        codes = statuses(one, 9, "/v1/estop", token, method)
        refused = {READER: 403, OPERATOR: 405, STRANGER: 401}[token]
        good = 405 if method == "GET" and token != STRANGER else refused
        assert codes == [good] * left + [429] * (9 - left)
        assert one.alarms == []


def test_neither_is_its_head():
    with running(limits=TIGHT) as one:
        connection = connect(one)
        for _ in range(9):
            connection.sendall(head("HEAD", "/v1/estop", token=READER))
            assert connection.recv(4096)
        connection.close()
        assert one.gate.counts["busy"] == 4


@pytest.mark.parametrize("path", ["/v1/estop", "/v1/hold", "/v1/missions", "/nowhere"])
@pytest.mark.parametrize(("token", "refused"), [(READER, 403), (STRANGER, 401)])
def test_a_flood_of_forbidden_requests_is_refused_unlogged(path, token, refused):
    with running(limits=TIGHT) as one:
        assert statuses(one, 9, path, token, "POST") == [refused] * 5 + [429] * 4
        assert one.alarms == []
        assert len(one.audited()) == (5 if token == READER else 0)


@pytest.mark.promise("emergency-stop-gets-through")
def test_an_operators_stop_is_served_while_others_flood_its_path():
    with running(limits=TIGHT) as one:
        for token in (READER, STRANGER):
            for method in ("GET", "POST"):
                assert 429 in statuses(one, 9, "/v1/estop", token, method)
        assert statuses(one, 20, "/v1/estop", OPERATOR, "POST") == [200] * 20
        assert len(one.alarms) == 20
        assert one.get("/v1/state")["seen"], "stops take none of the operator's room"


@pytest.mark.promise("emergency-stop-gets-through")
def test_a_stop_takes_effect_even_if_teleop_answers_late(monkeypatch):
    """The loop waits for its disk; other calls are dropped, for whoever asked looks again."""
    monkeypatch.setattr(api, "ANSWER_LIMIT", 0.1)
    with running() as one:
        one.flight.teleop.create(Order(SERVICE_PLAN), 0)
        one.until(lambda: one.state_of("m1") == "flying")
        free = threading.Event()
        one.bridge.take = lambda take=one.bridge.take: take() if free.is_set() else []
        assert one.post("/v1/missions/m1/cancel")[0] == 503
        assert one.post("/v1/estop")[0] == 503
        free.set()
        one.until(lambda: one.flight.guard is GuardState.ESTOP)
        one.until(lambda: one.state_of("m1") == "failed")
        assert one.flight.names("m1")[-1] == "emergency_stopped"
