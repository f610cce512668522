"""The route file is awaited, followed and accepted only with a numeric address."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from cloudrc.drivers.realtime import ROUTE_PERIOD_NS, Peer, Route, parse

HERE, THERE = ("127.0.0.1", 7401), ("10.1.2.3", 7400)


def write(path: Path, text: str, moment_ns: int) -> None:
    path.write_text(text)
    os.utime(path, ns=(moment_ns, moment_ns))


def test_a_route_is_read_again_when_it_changes(tmp_path: Path) -> None:
    path = tmp_path / "route"
    route = Route(path)
    assert route.look() is None
    write(path, "127.0.0.1:7401\n", 1)
    assert route.look() == HERE
    write(path, "10.1.2.3:7400", 2)
    assert route.look() == THERE


def test_one_that_does_not_change_is_not_read_again(tmp_path: Path) -> None:
    path = tmp_path / "route"
    write(path, "127.0.0.1:7401\n", 1)
    route = Route(path)
    route.look()
    node = path.stat().st_ino
    with path.open("r+") as file:  # the same file, with the same size and time
        file.write("127.0.0.1:7499\n")
    os.utime(path, ns=(1, 1))
    assert path.stat().st_ino == node
    assert route.look() == HERE


@pytest.mark.parametrize("text", ["", "127.0.0.1", "127.0.0.1:", ":7401", "\x00\xff", "name:7400"])
def test_what_is_no_address_changes_nothing(tmp_path: Path, text: str) -> None:
    path = tmp_path / "route"
    write(path, "127.0.0.1:7401\n", 1)
    route = Route(path)
    route.look()
    path.write_bytes(text.encode("latin-1"))
    os.utime(path, ns=(2, 2))
    assert route.look() == HERE
    write(path, "10.1.2.3:7400\n", 3)
    assert route.look() == THERE
    path.unlink()
    assert route.look() == THERE


def test_what_is_no_file_or_an_endless_one_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "route"
    write(path, "127.0.0.1:7401\n", 1)
    route = Route(path)
    route.look()
    for make in (os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")):
        path.rmdir() if path.is_dir() else path.unlink()
        make(path)
        assert route.look() == HERE


@pytest.mark.parametrize(
    "text",
    [
        "cloud:7400",
        "1.2.3:7400",
        "1.2.3.4:0",
        "1.2.3.4:65536",
        "1.2.3.4:x",
        "::1:7400",
        "[1.2.3.4]:1",
    ],
)
def test_only_numbers_are_an_address(text: str) -> None:
    with pytest.raises(ValueError, match="is not"):
        parse(text)


def test_an_ipv6_address_has_brackets() -> None:
    assert parse("[::1]:7400\n") == ("::1", 7400)


def test_a_peer_follows_its_route_twice_a_second(tmp_path: Path) -> None:
    path = tmp_path / "route"
    peer = Peer.bind(("127.0.0.1", 0), Route(path))
    with peer.socket, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        there.bind(("127.0.0.1", 0))
        there.settimeout(5)
        peer.follow(0)
        peer.send([b"to nobody"])
        assert (peer.address, peer.unsent) == (None, 1)
        write(path, f"127.0.0.1:{there.getsockname()[1]}\n", 1)
        peer.follow(ROUTE_PERIOD_NS - 1)
        assert peer.address is None
        peer.follow(ROUTE_PERIOD_NS)
        peer.send([b"hello"])
        assert there.recv(100) == b"hello"
    assert ROUTE_PERIOD_NS <= 500_000_000


def test_a_peer_with_an_address_stays_with_it() -> None:
    peer = Peer.bind(("127.0.0.1", 0), THERE)
    with peer.socket:
        peer.follow(10**12)
    assert peer.address == THERE
