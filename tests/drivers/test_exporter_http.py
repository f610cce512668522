"""The exporter over HTTP: probes, a used port, hostile clients."""

from __future__ import annotations

import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from cloudrc.drivers import exporter as probes
from cloudrc.drivers.exporter import Exporter
from cloudrc.errors import MissingPrerequisiteError

HOST = "127.0.0.1"


@pytest.fixture
def served() -> Iterator[tuple[Exporter, int]]:
    exporter = Exporter("link")
    port = exporter.serve((HOST, 0))
    yield exporter, port
    exporter.close()


def get(port: int, path: str, host: str = HOST) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://{host}:{port}{path}", timeout=10) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_metrics_and_probes_are_on_one_port(
    served: tuple[Exporter, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloudrc.drivers.exporter.KEPT", 0.0)
    exporter, port = served
    assert get(port, "/healthz") == (200, "alive\n")
    assert get(port, "/readyz") == (503, "no peer yet\n")
    assert "cloudrc_ready 0.0" in get(port, "/metrics")[1]
    exporter.ready(True)
    assert get(port, "/readyz")[0] == 200
    assert "cloudrc_ready 1.0" in get(port, "/metrics?name=any")[1]
    exporter.ready(False)
    assert get(port, "/readyz")[0] == 503


def test_a_page_is_made_at_most_four_times_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A page is at most 0.25 s old."""
    now, made = [1000.0], []
    monkeypatch.setattr("cloudrc.drivers.exporter.time", SimpleNamespace(monotonic=lambda: now[0]))
    exporter = Exporter("link")
    monkeypatch.setattr(exporter, "text", lambda: made.append(now[0]) or f"{now[0]}")
    for tick in range(3000):
        now[0] = 1000.0 + tick / 1024
        assert now[0] - float(exporter._page().content) < 0.25
    assert made == [1000.0 + quarter / 4 for quarter in range(12)]


def test_scrapers_that_come_at_once_have_one_page_made(
    served: tuple[Exporter, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    exporter, port = served
    monkeypatch.setattr("cloudrc.drivers.exporter.KEPT", 60.0)
    write, calls, all_wait = exporter.text, [], threading.Event()

    def slowly() -> str:
        calls.append(1)
        assert all_wait.wait(10.0)
        return write()

    monkeypatch.setattr(exporter, "text", slowly)
    with ThreadPoolExecutor(8) as scrapers:
        answers = [scrapers.submit(get, port, "/metrics") for _ in range(8)]
        while threading.active_count() < 16:  # eight clients and eight server threads
            assert get(port, "/healthz")[0] == 200  # probes do not wait for scrapes
        all_wait.set()
        pages = {each.result() for each in answers}
    assert (len(pages), len(calls)) == (1, 1)


def test_a_loop_that_stands_still_is_not_alive(
    served: tuple[Exporter, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Liveness does not depend on the other end, nor on the loop before its start."""
    exporter, port = served
    monkeypatch.setattr("cloudrc.drivers.exporter.STILL_MAX", -1.0)
    assert get(port, "/healthz") == (200, "alive\n")
    exporter.see([])
    assert get(port, "/healthz") == (503, "the loop has stood still for 0 s\n")
    monkeypatch.setattr("cloudrc.drivers.exporter.STILL_MAX", 60.0)
    assert get(port, "/healthz") == (200, "alive\n")


def test_probes_of_both_address_families_are_answered() -> None:
    exporter = Exporter("link")
    port = exporter.serve(("::", 0))
    assert {get(port, "/healthz", host)[0] for host in ("127.0.0.1", "[::1]")} == {200}
    exporter.close()


def test_another_path_says_which_there_are(served: tuple[Exporter, int]) -> None:
    assert get(served[1], "/") == (404, "there are /metrics, /healthz, /readyz, /link.json\n")


def test_the_text_is_what_it_says_it_is(served: tuple[Exporter, int]) -> None:
    with urllib.request.urlopen(f"http://{HOST}:{served[1]}/metrics", timeout=10) as answer:
        assert answer.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
        assert answer.read().endswith(b"\n")


def test_a_port_that_is_taken_is_told_in_one_sentence(served: tuple[Exporter, int]) -> None:
    with pytest.raises(MissingPrerequisiteError) as failure:
        Exporter("world").serve((HOST, served[1]))
    assert str(failure.value).startswith(f"metrics port {served[1]} is taken: ")
    assert "\n" not in str(failure.value)
    assert failure.value.exit_code == 3


def test_an_address_of_another_machine_is_told_likewise() -> None:
    with pytest.raises(MissingPrerequisiteError, match=r"cannot be served on 192\.0\.2\.1:9100: "):
        Exporter("world").serve(("192.0.2.1", 9100))


def test_it_answers_while_many_clients_hang(
    served: tuple[Exporter, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probes, "LIFETIME", 60.0)
    monkeypatch.setattr(probes._Handler, "timeout", 60.0)
    hanging = [
        socket.create_connection((HOST, served[1])) for _ in range(3 * probes.CONNECTIONS_MAX)
    ]
    for client in hanging[::2]:
        client.sendall(b"GET /metr")
    assert get(served[1], "/healthz")[0] == 200
    gone = [is_cut(client) for client in hanging]
    assert gone == sorted(gone, reverse=True), "the oldest had to go"
    assert gone.count(False) == probes.CONNECTIONS_MAX - 1  # the probe took the last place
    for client in hanging:
        client.close()


def is_cut(client: socket.socket) -> bool:
    """Check whether the server has closed a connection without an answer."""
    client.setblocking(False)
    try:
        return client.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def test_a_burst_of_connections_waits_and_is_not_refused(
    served: tuple[Exporter, int],
) -> None:
    exporter, port = served
    server = exporter._server
    assert server is not None
    waiting = []
    with server._guard:  # the server accepts no connection meanwhile
        for _ in range(500):  # with a full queue the kernel would delay a client by a second
            waiting.append(socket.create_connection((HOST, port), timeout=0.9))
    assert get(port, "/healthz")[0] == 200
    for client in waiting:
        client.close()


def test_a_client_that_hangs_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "LIFETIME", 0.0)
    exporter = Exporter("link")
    port = exporter.serve((HOST, 0))
    with socket.create_connection((HOST, port), timeout=10) as client:
        client.sendall(b"GET /metrics HT")
        assert client.recv(100) == b""
    exporter.close()


def test_a_closed_exporter_frees_its_port(served: tuple[Exporter, int]) -> None:
    exporter, port = served
    exporter.close()
    other = Exporter("link")
    assert other.serve((HOST, port)) == port
    other.close()
