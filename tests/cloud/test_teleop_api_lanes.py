"""Each role has room of its own in the API: readers cannot take an operator's."""

import contextvars
import threading

import pytest
from api_harness import LIMIT, OPERATOR, READER, connect, head, running

from cloudrc.cloud.teleop import api_events
from cloudrc.cloud.teleop.api_bridge import LANE, WAITING_MAX, Bridge
from cloudrc.cloud.teleop.api_gate import Limits
from cloudrc.cloud.teleop.service_book import UnavailableError


@pytest.mark.promise("P-API-7")
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


@pytest.mark.promise("P-API-7")
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


def test_each_role_waits_in_a_lane_of_its_own_and_operators_first():
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
