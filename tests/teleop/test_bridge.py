"""The bridge: calls are bounded, and stop and hold overtake them."""

import pytest

from cloudrc.teleop.bridge import WAITING_MAX, Bridge
from cloudrc.teleop.store import UnavailableError


@pytest.fixture
def bridge():
    one = Bridge()
    one.open(object())
    return one


def noting(made, what):
    return lambda service, now_ns: made.append(what)


@pytest.mark.promise("emergency-stop-gets-through")
def test_stop_and_hold_overtake_a_full_queue_of_calls(bridge):
    made = []
    calls = [bridge.submit(noting(made, number)) for number in range(WAITING_MAX)]
    with pytest.raises(UnavailableError, match=f"{WAITING_MAX} requests wait already"):
        bridge.submit(noting(made, "one too many"))
    calls[5].cancel()  # its client has gone: there is room for another
    bridge.submit(noting(made, "another"))
    holds = [bridge.submit(noting(made, "hold"), "hold") for _ in range(1000)]
    stops = [bridge.submit(noting(made, "stop"), "stop") for _ in range(1000)]
    for call in bridge.take():
        call(0)
    others = [number for number in range(WAITING_MAX) if number != 5]
    assert made == ["stop", "hold", *others, "another"]
    assert all(each.done() for each in (*holds, *stops)), "all who asked get the answer"
    assert bridge.overtakings == 2000


def test_only_a_stop_is_taken_before_new_telemetry(bridge):
    made = []
    bridge.submit(noting(made, "hold"), "hold")
    bridge.submit(noting(made, "stop"), "stop")
    for call in bridge.take_urgent():
        call(0)
    assert made == ["stop"]
    assert (len(bridge.take()), bridge.take_urgent()) == (1, [])


def test_an_error_of_a_call_reaches_its_caller(bridge):
    asked = bridge.submit(lambda service, now_ns: service.nothing)
    for call in bridge.take():
        call(0)
    with pytest.raises(AttributeError):
        asked.result()
