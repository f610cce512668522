"""The tap: a new session and the newest samples reach a console, which never delays cloud."""

import time

import pytest

from cloudrc.drivers import tap
from cloudrc.drivers.tap import ALONE_PERIOD, PERIOD, Tap, TapListener
from cloudrc.errors import BadInputError
from cloudrc.records import Arrival, Counted, SessionOpened
from tests.console.conftest import control, told


class FakeTime:
    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = FakeTime()
    monkeypatch.setattr(tap, "time", made)
    return made


@pytest.fixture
def ends(tmp_path):
    """A tap whose telemetry is that of 0.1 s, and its listener."""
    listener = TapListener(tmp_path / "tap.sock")
    sender = Tap(tmp_path / "tap.sock", lambda: told(0.1).telemetry)
    yield sender, listener
    listener.close()
    sender._socket.close()


def test_a_datagram_has_a_new_session_and_the_newest_samples(clock, ends):
    sender, listener = ends
    for _ in range(2):
        sender.tell([])  # the next datagram is due after a period
    listener.receive(0.1)
    used, late = Arrival(1, True, 1, 1, 0.03, True), Arrival(2, True, 1, 2, 0.3, False)
    old, new = (SessionOpened(n, "cloud", n, "") for n in (1, 2))
    sender.tell([old, used, control(0.1), Counted(1, "cloud", "sent", 1)])
    sender.tell([new, control(0.2), late])
    assert listener.receive(0) == []
    clock.now += PERIOD
    sender.tell([])
    found = listener.receive(0.1)
    assert found[:2] == [new, used]
    assert [record for record in found if isinstance(record, Arrival)] == [used]
    assert found[2].stamp_ns == 200_000_000
    assert found[3:] == [told(0.1)]


def test_a_blocked_or_missing_console_costs_no_wait(clock, ends):
    sender, listener = ends
    began = time.perf_counter()
    for _ in range(2000):  # many more than the socket keeps
        clock.now += PERIOD
        sender.tell([control(0.1)])
    listener.close()
    calls = []
    sender._telemetry = lambda: calls.append(1)
    for _ in range(2000):
        clock.now += PERIOD
        sender.tell([control(0.1)])
    assert time.perf_counter() - began < 10
    assert len(calls) <= 2000 * PERIOD / ALONE_PERIOD + 1, "without a listener nothing is encoded"


def test_a_run_has_one_console(tmp_path):
    path = tmp_path / "tap.sock"
    first = TapListener(path)
    with pytest.raises(BadInputError, match="has a console already"):
        TapListener(path)
    first._socket.close()  # killed: its file stays
    TapListener(path).close()
    assert not any(tmp_path.iterdir())
