"""The API under load: floods and slow clients are cut off, and the emergency stop comes through."""

import json
import socket
import threading
import time

import pytest

from cloudrc.teleop import api, server
from cloudrc.teleop import api as api_errors
from cloudrc.teleop import api as api_events
from cloudrc.teleop.bridge import WAITING_MAX, Bridge
from cloudrc.teleop.server import Bucket, Limits
from tests.teleop.conftest import OPERATOR, READER, ServiceFlight, connect, head, running

A_MISSION = {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}
TIGHT = Limits(rate_hz=0.001, burst=5, in_flight=2, streams=1)


def is_cut_off(connection):
    """Whether the other side closes without a word."""
    try:
        return connection.recv(4096) == b""
    except ConnectionResetError:
        return True
    finally:
        connection.close()


def test_a_flood_by_one_role_leaves_the_others_alone():
    with running(limits=TIGHT) as one:
        for token, left in (("no-token-that-is-known", 5), (READER, 5), (OPERATOR, 4)):
            # `running` has asked once as the operator.
            codes = [one.send(one.request("/v1/state", token=token))[0] for _ in range(12)]
            good = 401 if token.startswith("no") else 200
            assert codes == [good] * left + [429] * (12 - left)
        assert one.gate.counts["busy"] == 22
        status, answer = one.post("/v1/hold")
        assert (status, answer) == (429, {"detail": "too many requests; try again in a second"})


@pytest.mark.promise("emergency-stop-gets-through")
def test_the_emergency_stop_is_served_while_a_flood_is_refused():
    with running(limits=TIGHT) as one:
        while one.post("/v1/hold")[0] != 429:
            pass
        assert one.post("/v1/missions", A_MISSION)[0] == 429
        for _ in range(20):
            assert one.post("/v1/estop")[0] == 200
        one.until(lambda: one.flight.guard.name == "ESTOP")


@pytest.mark.promise("emergency-stop-gets-through")
def test_the_emergency_stop_passes_by_what_waits_for_the_loop():
    bridge, calls = Bridge(), []
    bridge.open(ServiceFlight().teleop)
    for number in range(WAITING_MAX):
        bridge.submit(lambda s, now_ns, number=number: calls.append(number))
    bridge.submit(lambda s, now_ns: calls.append("stop"), urgent=True)
    for call in bridge.take():
        call(0)
    assert calls == ["stop", *range(WAITING_MAX - 1)]


def test_so_many_are_worked_on_at_once_and_no_more(monkeypatch):
    monkeypatch.setattr(api, "ANSWER_LIMIT", 1.0)
    with running(limits=Limits(1e6, 10**6, in_flight=2, streams=1)) as one:
        one._stopping.set()  # the loop hangs
        one._thread.join()
        slow = [connect(one) for _ in range(2)]
        for connection in slow:
            connection.sendall(head("GET", "/v1/state"))
        one.until(lambda: one.gate._in_flight["operator", "request"] == 2)
        assert one.post("/v1/hold")[0] == 429
        assert [b" 503 " in connection.recv(4096) for connection in slow] == [True, True]
        assert one.post("/v1/hold")[0] == 503
        for connection in slow:
            connection.close()


def test_so_many_streams_and_no_more(monkeypatch):
    monkeypatch.setattr(api_events, "LOOK_PERIOD", 0.01)
    with running(limits=Limits(1e6, 10**6, 64, streams=1)) as one:
        stream = connect(one)
        stream.sendall(head("GET", "/v1/events"))
        said = b""
        while b": cloudrc" not in said:
            said += stream.recv(4096)
        assert one.send(one.request("/v1/events"))[0] == 429
        assert one.get("/v1/state")
        stream.close()
        one.until(lambda: one.gate._in_flight["operator", "stream"] == 0)


def test_the_limits_are_those_that_are_promised():
    limits = (server.HEAD_LIMIT, api_errors.BODY_LIMIT, server.SEND_LIMIT)
    assert limits == (5.0, 5.0, 10.0)


@pytest.mark.parametrize("said", [b"", b"GET / HT", head("GET", "/v1/state")[:-2]])
def test_a_client_that_dawdles_over_its_head_is_cut_off(monkeypatch, said):
    monkeypatch.setattr(server, "HEAD_LIMIT", 0.1)
    with running() as one:
        connection = connect(one)
        connection.sendall(said)
        assert is_cut_off(connection)
        assert one.server.counts["slow"] >= 1


def test_so_is_one_that_dawdles_over_its_second(monkeypatch):
    """Each byte comes in time for a limit between two bytes: the whole head has one."""
    monkeypatch.setattr(server, "HEAD_LIMIT", 0.3)
    with running() as one:
        connection = connect(one)
        connection.sendall(head("GET", "/v1/state"))
        assert b" 200 " in connection.recv(65_536)
        began, cut = time.monotonic(), False
        for byte in head("GET", "/v1/state", "X: " + "y" * 200):
            try:
                connection.sendall(bytes([byte]))
            except OSError:
                cut = True
                break
            time.sleep(0.01)
        assert cut
        assert time.monotonic() - began < 2.0
        connection.close()


def test_a_body_that_does_not_come_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(api, "BODY_LIMIT", 0.1)
    with running() as one:
        connection = connect(one)
        connection.sendall(head("POST", "/v1/missions", "Content-Length: 100") + b"{")
        assert b" 408 " in connection.recv(4096)
        connection.close()


def test_a_client_that_leaves_during_its_body_is_no_api_fault():
    with running() as one:
        one.until(lambda: one.gate.counts["served"] == 1)  # `running` has asked once
        connection = connect(one)
        connection.sendall(head("POST", "/v1/missions", "Content-Length: 100") + b"{")
        time.sleep(0.1)
        connection.close()
        one.until(lambda: one.gate.counts.total() == 2)
        assert one.gate.counts["failed"] == 0
        assert one.complaints == []


def test_a_body_that_says_it_is_too_long_is_not_read():
    with running() as one:
        connection = connect(one)
        connection.sendall(head("POST", "/v1/missions", "Content-Length: 262145"))
        assert b" 413 " in connection.recv(4096)
        connection.close()
        connection = connect(one)
        connection.sendall(head("POST", "/v1/goto", "Transfer-Encoding: chunked"))
        with_chunks = b"10000\r\n" + b" " * 0x10000 + b"\r\n"
        for _ in range(5):
            connection.sendall(with_chunks)
        assert b" 413 " in connection.recv(4096)
        connection.close()


@pytest.mark.parametrize(
    "body",
    [
        b"[" * 200_000,
        b'{"a":' * 50_000,
        b'{"waypoints":' + b"[" * 100_000,
        b'{"waypoints": [' + b"0," * 100_000 + b"0]}",
        b'{"waypoints": [' + b'{"position_m": [0, 0, 1]},' * 10_001 + b"0]}",
        b'{"name": "' + b"x" * 200_000 + b'"}',
        b'{"time_limit_s": 1' + b"0" * 200_000 + b"}",
    ],
)
def test_deep_long_and_large_missions_are_refused(body):
    with running() as one:
        began = time.monotonic()
        status, answer = one.post("/v1/missions", body)
        assert status in (413, 422)
        assert answer["detail"]
        assert time.monotonic() - began < 2.0
        assert one.flight.kept == []


def test_in_a_crowd_those_that_have_waited_longest_go(monkeypatch):
    monkeypatch.setattr(server, "CONNECTIONS_MAX", 20)
    with running() as one:
        crowd = [connect(one) for _ in range(60)]
        one.until(lambda: one.server.counts["busy"] >= 40)
        assert one.post("/v1/estop")[0] == 200
        assert is_cut_off(crowd[0])
        newest = crowd[-1]
        newest.sendall(head("GET", "/v1/state"))
        assert b" 200 " in newest.recv(65_536)
        for connection in crowd:
            connection.close()


def test_a_client_that_takes_nothing_is_cut_off(monkeypatch):
    monkeypatch.setattr(server, "SEND_LIMIT", 0.2)
    with running() as one:
        name = "x" * 200
        for number in range(60):
            order = {**A_MISSION, "name": name, "key": f"{name[:190]}{number}"}
            _, view = one.post("/v1/missions", order)
            one.post(f"/v1/missions/{view['id']}/cancel")
        connection = connect(one)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        asking = threading.Thread(target=flood, args=(connection,))
        asking.start()
        one.until(lambda: one.server.counts["slow"] >= 1)
        asking.join(5.0)
        assert not asking.is_alive()
        connection.close()


def flood(connection):
    """Ask on and on, and never read."""
    try:
        for _ in range(50_000):
            connection.sendall(head("GET", "/v1/missions"))
    except OSError:
        pass


def test_a_bucket_fills_again(monkeypatch):
    from cloudrc.teleop import server

    now = [0.0]
    monkeypatch.setattr(server.time, "monotonic", lambda: now[0])
    bucket = Bucket(10.0, 3)
    assert [bucket.take() for _ in range(4)] == [True, True, True, False]
    now[0] = 0.1
    assert [bucket.take() for _ in range(2)] == [True, False]
    now[0] = 1e6
    assert [bucket.take() for _ in range(4)] == [True, True, True, False]


def test_counts_become_metrics():
    from cloudrc.exposition.live import LiveMetrics
    from cloudrc.records import Counted

    live = LiveMetrics("teleop")
    counts = {"api_served": 7, "api_token": 2, "api_slow": 1, "api_audit_dropped": 3}
    live.see(Counted(0, "teleop", name, total) for name, total in counts.items())
    live.see([Counted(0, "teleop", "journal_repaired", 1)])
    readings = live.read()
    assert readings["cloudrc_api_requests_total"] == {(): 7}
    assert readings["cloudrc_api_rejected_total"][("token",)] == 2
    assert readings["cloudrc_api_rejected_total"][("busy",)] == 0
    assert readings["cloudrc_audit_dropped_total"] == {(): 3}
    assert readings["cloudrc_journal_repaired_total"] == {(): 1}
    assert json.dumps(sorted(k[0] for k in readings["cloudrc_api_rejected_total"]))
