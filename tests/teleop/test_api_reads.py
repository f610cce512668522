"""What strangers send is work for the thread that serves the emergency stop: little at a time."""

import http.client
import time

import pytest

from cloudrc.teleop import server
from tests.teleop.conftest import connect, head, running

CHUNK = b"1\r\nx\r\n"


def until_closed(connection):
    """What the other side says before it closes."""
    said = b""
    try:
        while some := connection.recv(65_536):
            said += some
    except ConnectionResetError:
        pass
    finally:
        connection.close()
    return said


def test_the_server_reads_connections_in_small_turns(monkeypatch):
    taken, take = [], server.PatientProtocol.data_received

    def seen(protocol, data):
        taken.append(len(data))
        take(protocol, data)

    monkeypatch.setattr(server.PatientProtocol, "data_received", seen)
    with running() as one:
        chunks = CHUNK * 20_000
        lines = f"Content-Length: {len(chunks)}"
        connection = connect(one)
        connection.sendall(head("POST", "/v1/missions", lines) + chunks)
        assert b" 422 " in connection.recv(4096)
        connection.close()
    assert sum(taken) > len(chunks)
    assert max(taken) == server.READ_MAX <= 1024


def test_chunks_after_the_answer_are_not_parsed():
    with running() as one:
        connection = connect(one)
        connection.settimeout(3.0)  # before its patience ends
        chunked = head("POST", "/v1/missions", "Transfer-Encoding: chunked", token="nobody's")
        connection.sendall(chunked + CHUNK)
        assert until_closed(connection).startswith(b"HTTP/1.1 401 ")


def test_a_complete_chunked_body_keeps_the_connection_open():
    with running() as one, connect(one) as connection:
        chunked = head("POST", "/v1/hold", "Transfer-Encoding: chunked")
        for _ in range(3):
            connection.sendall(chunked + CHUNK + b"0\r\n\r\n")
            answer = http.client.HTTPResponse(connection)
            answer.begin()
            assert answer.read()


def test_an_oversized_head_in_one_piece_is_refused():
    assert server.HEAD_MAX <= 4096, "lines of four bytes each: 64 such heads take a while"
    with running() as one:
        with connect(one) as connection:
            rest = server.HEAD_MAX - len(head("GET", "/v1/state", "X: "))
            connection.sendall(head("GET", "/v1/state", "X: " + "y" * rest))
            assert b" 200 " in connection.recv(65_536)
        connection = connect(one)
        connection.sendall(head("GET", "/v1/state", "X: " + "y" * server.HEAD_MAX * 2))
        assert until_closed(connection).startswith(b"HTTP/1.1 400 ")


@pytest.mark.promise("emergency-stop-gets-through")
def test_a_stop_before_a_crowd_of_connections_is_served():
    """All of them while the server's thread is busy: it takes them when it is free again."""
    with running() as one:
        loop = one.server._server.servers[0].get_loop()
        loop.call_soon_threadsafe(time.sleep, 1.0)
        stop = connect(one)
        stop.sendall(head("POST", "/v1/estop", "Content-Length: 0"))
        crowd = [connect(one) for _ in range(server.CONNECTIONS_MAX + 50)]
        assert not one.alarms  # all of them wait in the kernel
        assert b" 200 " in stop.recv(4096)
        assert one.alarms
        for connection in (stop, *crowd):
            connection.close()
