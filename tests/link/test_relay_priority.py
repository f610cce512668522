"""What a relay asks of the machine: to run first, and to be woken when it asked to be."""

from __future__ import annotations

import ctypes
import os
import sys
import threading

import pytest

from cloudrc.link.relay import ask_for_fifo, runs_first
from cloudrc.link.relay_io import tighten_slack

linux = pytest.mark.skipif(sys.platform != "linux", reason="Linux alone has it")
GET_TIMERSLACK = 30


def in_a_thread(act) -> list[object]:  # type: ignore[no-untyped-def]
    """What `act` returns in a thread of its own: whatever it asks for ends with that thread."""
    found: list[object] = []
    thread = threading.Thread(target=lambda: found.append(act()))
    thread.start()
    thread.join()
    return found


@linux
def test_the_slack_of_the_thread_that_asks_is_a_nanosecond() -> None:
    def slack_ns() -> int:
        tighten_slack()
        return ctypes.CDLL(None).prctl(GET_TIMERSLACK, 0, 0, 0, 0)

    assert in_a_thread(slack_ns) == [1]


@linux
def test_a_permitted_thread_has_priority_and_its_children_do_not() -> None:
    def ask() -> object:
        refused = ask_for_fifo()
        return not refused, runs_first(), in_a_thread(runs_first) == [True]

    ((may, first, others_too),) = in_a_thread(ask)  # type: ignore[misc]
    assert first is may
    assert not others_too


def test_who_may_not_is_told_why_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert ask_for_fifo() == "Operation not permitted; it takes CAP_SYS_NICE or a limit on rtprio"
    monkeypatch.delattr(os, "SCHED_FIFO")
    assert ask_for_fifo() == "this system has no SCHED_FIFO"
