"""An emergency stop while cloud's socket is full and teleop's loop waits for its disk."""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli import teleop
from cloudrc.cli import teleop as teleop_alarm
from cloudrc.cli.teleop import EmergencyStopSender, ServedApi
from cloudrc.drivers.teleop import UnixPeer
from cloudrc.teleop.bridge import Bridge
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.wire import ALARM, encode

Peers = tuple[UnixPeer, UnixPeer]
WORD = encode(ALARM)


def fill(peer: UnixPeer) -> None:
    """Fill the socket of a stalled cloud."""
    while peer.send(b"setpoint"):
        pass


def until(condition: Callable[[], object], limit: float = 5.0) -> None:
    """Wait at most `limit` [s] for a condition."""
    ends = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.002)


def threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "alarm"]


def heard(peer: UnixPeer) -> int:
    return peer.receive().count(WORD)


@pytest.fixture(autouse=True)
def _none_is_left() -> Any:
    yield
    until(lambda: not threads())


@pytest.mark.promise("emergency-stop-gets-through")
def test_a_full_socket_delays_an_emergency_stop_until_drained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = UnixPeer(tmp_path / "cloud.sock", tmp_path / "teleop.sock")
    bridge = Bridge()
    told: list[int] = []  # number of stops received at each check

    def hangs(service: MissionService, peer: UnixPeer, *codec: Any, **rest: Any) -> None:
        """A loop that waits for its disk."""
        fill(peer)
        began = time.monotonic()
        bridge.alarm()
        assert time.monotonic() - began < 0.5  # the API's thread continues
        until(lambda: told.append(heard(cloud)) or any(told), 1.0)  # cloud reads again
        until(lambda: not threads())
        told.append(heard(cloud))
        peer.close()

    monkeypatch.setattr("cloudrc.drivers.teleop.serve_teleop", hangs)
    monkeypatch.setattr("cloudrc.drivers.feed.Feed.on_stdout", lambda **how: _Feed())
    options = argparse.Namespace(socket=tmp_path, feed=False)
    served = ServedApi(bridge, None, None)  # type: ignore[arg-type]
    teleop._fly(options, MissionService(1.0, salt=bytes(16)), served, None, lambda: True, "")
    cloud.close()
    assert sum(told) == 1


class _Feed:
    """A feed that nobody reads."""

    def ready(self) -> None:
        """It is."""

    def alive_while(self, stop: Callable[[], bool]) -> Callable[[], bool]:
        return stop


def test_one_that_is_taken_at_once_starts_no_thread(peers: Peers) -> None:
    teleop_peer, cloud = peers
    EmergencyStopSender(lambda: teleop_peer.send(WORD))()
    assert threads() == []
    assert heard(cloud) == 1


def test_a_cloud_that_is_away_hears_it_when_it_is_back(peers: Peers, tmp_path: Path) -> None:
    teleop_peer, cloud = peers
    cloud.close()
    EmergencyStopSender(lambda: teleop_peer.send(WORD))()
    back = UnixPeer(tmp_path / "b.sock", tmp_path / "a.sock")
    until(lambda: heard(back))
    back.close()


def test_however_often_it_is_asked_for_there_is_one_thread(peers: Peers) -> None:
    teleop_peer, cloud = peers
    fill(teleop_peer)
    alarm = EmergencyStopSender(lambda: teleop_peer.send(WORD))
    callers = [threading.Thread(target=alarm) for _ in range(20)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(threads()) == 1
    until(lambda: heard(cloud))
    until(lambda: not threads())
    fill(teleop_peer)  # and fill it again
    alarm()
    assert len(threads()) == 1
    until(lambda: heard(cloud))


def test_the_last_word_counts_for_how_long_it_is_repeated(
    peers: Peers, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    tries: list[float] = []

    def send() -> bool:
        tries.append(clock[0])
        return False

    def sleep(seconds: float) -> None:
        clock[0] += seconds
        if len(tries) == 51:  # half of the time has passed
            again.set()
            asked.wait()

    again, asked = threading.Event(), threading.Event()
    monkeypatch.setattr(teleop_alarm, "time", _Clock(clock, sleep))
    alarm = EmergencyStopSender(send)
    alarm()
    again.wait(5.0)
    (repeats,) = threads()
    alarm()
    asked.set()
    repeats.join(5.0)
    assert not repeats.is_alive()
    assert tries[-1] == pytest.approx(103.0, abs=0.1)
    assert tries[1] - tries[0] == pytest.approx(0.02)


class _Clock:
    """Replaces the module `time`."""

    def __init__(self, now: list[float], sleep: Callable[[float], None]) -> None:
        self.monotonic, self.sleep = (lambda: now[0]), sleep


def test_what_was_taken_meanwhile_is_not_said_again(monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[bool] = []

    def send() -> bool:
        tries.append(bool(tries))  # the first attempt fails
        return tries[-1]

    asked = threading.Event()
    monkeypatch.setattr(teleop_alarm, "time", _Clock([100.0], lambda seconds: asked.wait(5.0)))
    alarm = EmergencyStopSender(send)
    alarm()
    (repeats,) = threads()
    alarm()
    asked.set()
    repeats.join(5.0)
    assert not repeats.is_alive()
    assert tries == [False, True]


def test_where_there_can_be_no_thread_the_caller_goes_on(
    peers: Peers, monkeypatch: pytest.MonkeyPatch
) -> None:
    teleop_peer, cloud = peers
    fill(teleop_peer)
    alarm = EmergencyStopSender(lambda: teleop_peer.send(WORD))

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        alarm()
    alarm()  # now it is possible
    until(lambda: heard(cloud))
