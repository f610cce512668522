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
from cloudrc.cli.teleop import ServedApi
from cloudrc.drivers.teleop import EmergencyStopSender, UnixPeer
from cloudrc.teleop.bridge import Bridge
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import MissionStore, connect
from cloudrc.teleop.wire import ALARM, encode

Peers = tuple[UnixPeer, UnixPeer]
WORD = encode(ALARM)
PAUSE = threading.Event()


def fill(peer: UnixPeer) -> None:
    """Fill the socket of a stalled cloud."""
    while peer.send(b"setpoint"):
        pass


def until(condition: Callable[[], object], limit: float = 5.0) -> None:
    """Wait at most `limit` [s] for a condition."""
    ends = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < ends
        PAUSE.wait(0.002)


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
    service = MissionService(1.0, MissionStore(connect(), b""))
    teleop._fly(options, service, served, None, lambda: True)
    cloud.close()
    assert sum(told) == 1


class _Feed:
    """A thread pool without threads."""

    def ready(self) -> None:
        """It is."""


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


def test_however_often_it_is_asked_for_there_is_one_thread(
    peers: Peers, monkeypatch: pytest.MonkeyPatch
) -> None:
    teleop_peer, cloud = peers
    alarm = EmergencyStopSender(lambda: teleop_peer.send(WORD))
    for _ in range(2):
        fill(teleop_peer)
        callers = [threading.Thread(target=alarm) for _ in range(20)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
        assert len(threads()) == 1
        until(lambda: heard(cloud))
        until(lambda: not threads())

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    fill(teleop_peer)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        alarm()  # the caller goes on
    alarm()  # now it is possible
    until(lambda: heard(cloud))


def test_it_gives_up_after_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("cloudrc.drivers.teleop.time.sleep", slept.append)
    EmergencyStopSender(lambda: False)()
    for thread in threads():
        thread.join(5.0)
    assert sum(slept) == pytest.approx(2.0)
