"""recvmmsg and sendmmsg carry the same bytes, stamps and counts as one datagram at a time."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterator

import pytest

from cloudrc.link.relay import bind_loopback
from cloudrc.link.relay_io import (
    Receiver,
    SelectWait,
    Sender,
    TimerWait,
    ask_for_stamps,
    available,
    best_wait,
)

pytestmark = pytest.mark.skipif(not available(), reason="Linux on 64-bit machines only")
Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    with bind_loopback() as one, bind_loopback() as other:
        for end in (one, other):
            end.setblocking(False)
            ask_for_stamps(end)
        yield one, other


def test_what_is_sent_in_one_call_arrives_as_it_was(pair: Pair) -> None:
    sender, receiver = Sender(pair[0], 8, 64), Receiver(pair[1], 8, 64)
    for datagrams in ([b"a" * n for n in (0, 1, 64)], [b"second", b""], [b"x"] * 8):
        assert sender.send(datagrams, pair[1].getsockname()) == len(datagrams)
        before_ns = time.time_ns()
        found = receiver.receive()
        assert [data for data, _, _ in found] == datagrams
        stamps = [wall_ns or 0 for _, wall_ns, _ in found]
        assert before_ns - 1_000_000_000 < stamps[0] <= stamps[-1] <= time.time_ns()
        assert {dropped for _, _, dropped in found} == {None}
    assert receiver.receive() == []


def test_excess_datagrams_wait_and_too_long_ones_are_named(pair: Pair) -> None:
    receiver = Receiver(pair[1], 3, 16)
    for n in range(5):
        pair[0].sendto(bytes([n] * (17 if n == 1 else 16)), pair[1].getsockname())
    assert [data and data[0] for data, _, _ in receiver.receive()] == [0, None, 2]
    assert [data and data[0] for data, _, _ in receiver.receive()] == [3, 4]


def test_the_kernels_drops_are_told(pair: Pair) -> None:
    pair[1].setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    receiver, sent = Receiver(pair[1], 64, 512), 100
    for _ in range(sent):
        pair[0].sendto(bytes(200), pair[1].getsockname())
    arrived = len(receiver.receive())
    pair[0].sendto(b"one more", pair[1].getsockname())
    ((_, _, dropped),) = receiver.receive()
    assert (dropped or 0) + arrived == sent
    assert arrived < sent


def test_an_address_that_is_a_name_is_left_to_others(pair: Pair) -> None:
    assert Sender(pair[0], 2, 16).send([b"x"], ("localhost", 9)) == 0


def test_a_refusal_ends_the_batch(pair: Pair) -> None:
    sender = Sender(pair[0], 2, 16)
    assert sender.send([b"x", b"y"], ("255.255.255.255", 9)) == 0  # no permission to broadcast
    assert sender.send([b"x", b"y"], pair[1].getsockname()) == 2


@pytest.mark.parametrize("kind", [TimerWait, SelectWait])
def test_both_ways_to_wait_see_datagrams_and_instants(
    pair: Pair, kind: type[TimerWait] | type[SelectWait]
) -> None:
    wait = kind(pair)
    due_ns = time.monotonic_ns() + 3_000_000
    assert list(wait.until(due_ns, 5.0)) == []
    assert time.monotonic_ns() >= due_ns
    assert list(wait.until(due_ns, 5.0)) == []  # has passed: only looks
    assert list(wait.until(None, 0.001)) == []
    pair[0].sendto(b"x", pair[1].getsockname())
    assert list(wait.until(time.monotonic_ns() + 10**10, 5.0)) == [pair[1].fileno()]
    wait.close()


def test_linux_has_the_exact_one(pair: Pair) -> None:
    wait = best_wait(pair)
    assert isinstance(wait, TimerWait) == (sys.platform == "linux")
    wait.close()
