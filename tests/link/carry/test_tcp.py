# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link relay tcp` between real sockets of this machine."""

import hashlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from cloudrc.flight.pod.realtime import free_ports

pytestmark = pytest.mark.process


@contextmanager
def server(handle):
    """Serve each connection on a thread by `handle(socket)`; yield the port."""
    listening = socket.create_server(("127.0.0.1", 0), backlog=256)

    def accept():
        while True:
            try:
                one, _ = listening.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(one,), daemon=True).start()

    def serve(one):
        with one, suppress(OSError):
            handle(one)

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield listening.getsockname()[1]
    finally:
        listening.shutdown(socket.SHUT_RDWR)
        listening.close()


def echo(one):
    while data := one.recv(1 << 16):
        one.sendall(data)
    one.sendall(b"end")


class Relayed:
    """A relay as a process of its own."""

    def __init__(self, port, *flags):
        (self.port,) = free_ports(1)
        listen = ("--listen", f"127.0.0.1:{self.port}")
        words = (sys.executable, "-m", "cloudrc", "link", "relay", "tcp", *listen)
        more = ("--to", f"127.0.0.1:{port}", "-o", "json", *flags)
        pipe = subprocess.PIPE
        self.process = subprocess.Popen((*words, *more), stdout=pipe, stderr=pipe, text=True)
        assert " leads to " in self.process.stderr.readline()

    def connect(self):
        return socket.create_connection(("127.0.0.1", self.port), 20.0)

    def memory(self):
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(text.split("VmRSS:")[1].split()[0]) * 1024

    def end(self):
        self.process.send_signal(signal.SIGINT)
        out, _ = self.process.communicate(timeout=20)
        assert self.process.returncode == 0
        return json.loads(out)


@pytest.fixture
def relayed():
    """Return a function that starts a relay to a port."""
    made = []

    def start(port, *flags):
        made.append(Relayed(port, *flags))
        return made[-1]

    yield start
    for one in made:
        if one.process.poll() is None:
            one.process.kill()
            one.process.communicate()


SHORT = ("--link", "paper-p3", "--set", "uplink.delay_ms=20", "--set", "downlink.delay_ms=20",
         "--set", "uplink.jitter_ms=0", "--set", "downlink.jitter_ms=0")  # fmt: skip


def test_bytes_turns_and_a_half_close_cross_the_link(relayed):
    with server(echo) as port:
        relay = relayed(port, *SHORT)
        began = time.monotonic()  # the relay opens its side as soon as it has this one
        with relay.connect() as client:
            took = []
            for said in (b"hello", b"again"):
                client.sendall(said)
                assert client.recv(100) == said
                took.append(time.monotonic() - began)
                began = time.monotonic()
            client.shutdown(socket.SHUT_WR)
            assert client.recv(100) == b"end"
            assert client.recv(100) == b""
        assert 0.080 <= took[0] <= 0.2  # a round trip to open, and one for the turn
        assert 0.040 <= took[1] <= 0.1
        report = relay.end()
    assert (report["connections"], report["uplink_bytes"], report["downlink_bytes"]) == (1, 10, 13)
    assert report["turns"]["count"] == 2
    assert report["turns"]["max"] >= 0.08 - 0.001


@pytest.mark.parametrize("flags", [("--link", "lte"), (*SHORT, "--set", "uplink.loss=0.01")])
def test_what_arrives_is_what_was_sent(relayed, flags):
    data = os.urandom(2_000_000)
    with server(echo) as port:
        relay = relayed(port, *flags)
        with relay.connect() as client:
            threading.Thread(target=lambda: (client.sendall(data), client.shutdown(1))).start()
            found = b"".join(iter(lambda: client.recv(1 << 16), b""))
    assert hashlib.sha256(found).digest() == hashlib.sha256(data + b"end").digest()


def test_a_refused_port_refuses_the_client_after_a_round_trip(relayed):
    (closed,) = free_ports(1)
    relay = relayed(closed, *SHORT)
    began = time.monotonic()
    with relay.connect() as client, pytest.raises(ConnectionResetError):
        client.recv(1)
    assert 0.040 <= time.monotonic() - began <= 0.2
    assert relay.end()["refused"] == 1


def test_a_reset_reaches_the_other_end(relayed):
    told = threading.Event()

    def handle(one):
        try:
            while one.recv(100):
                pass
        except ConnectionResetError:
            told.set()

    with server(handle) as port:
        relay = relayed(port, *SHORT)
        client = relay.connect()
        client.sendall(b"x")
        time.sleep(0.2)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        client.close()
        assert told.wait(5.0)


def test_a_stopped_reader_stops_the_sender_and_memory_stays_small(relayed):
    stop = threading.Event()
    with server(lambda one: stop.wait(60)) as port:
        relay = relayed(port, *SHORT)
        with relay.connect() as client:
            client.sendall(b"x")
            time.sleep(0.3)
            before = relay.memory()
            client.setblocking(False)
            sent, block = 0, bytes(1 << 20)
            quiet = time.monotonic()
            with selectors.DefaultSelector() as selector:
                selector.register(client, selectors.EVENT_WRITE)
                while time.monotonic() - quiet < 1.5 and sent < 1 << 30:
                    if selector.select(0.1):
                        sent += client.send(block)
                        quiet = time.monotonic()
            assert sent < 64 << 20
            assert relay.memory() - before < 50 << 20
        stop.set()


def test_link_set_acts_on_an_open_connection(relayed, tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    latest = tmp_path / "runs" / "latest"  # a flight that has ended
    latest.mkdir(parents=True)
    (latest / "uplink.log").touch()
    with server(echo) as port:
        relay = relayed(port, *SHORT)
        with relay.connect() as client:
            client.sendall(b"x")
            client.recv(1)
            call("link set downlink.delay_ms=200")
            began = time.monotonic()
            client.sendall(b"y")
            client.recv(1)
            assert 0.220 <= time.monotonic() - began <= 0.35
            assert "link exec" in call("link set uplink.reorder=0.1", code=2).err
