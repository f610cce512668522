"""A guard that ends its HOLDs otherwise than it should is found by a flight that is held."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.faults.fuzz import fly
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.world.guard import state as guard_module
from cloudrc.world.guard.limits import Limits
from cloudrc.world.guard.state import Guard


def _resumes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    init = Guard.__init__

    def hasty(guard: Guard, limits: Any) -> None:
        init(guard, limits)
        guard._fresh_ns = guard_module.deque(maxlen=1)

    monkeypatch.setattr(guard_module, "RESUME_COMMANDS", 1)
    monkeypatch.setattr(Guard, "__init__", hasty)


def _speeds_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Limits, "ramp_ns", 0)


def _chatters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard_module, "SETTLE_NS", 0)


def _holds_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if only TRACK kept its distance from the last one."""

    def settled(guard: Guard, now_ns: int, fresh_until_ns: int) -> bool:
        return guard._take_off.allowed and now_ns - guard._tracked_ns >= guard_module.SETTLE_NS

    monkeypatch.setattr(Guard, "_settled", settled)


def _waits_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Limits, "alone_max_ns", lambda limits, flies: 3_600_000_000_000)


def _lands_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Limits, "alone_max_ns", lambda limits, flies: 100_000_000)


HELD = Schedule(
    3,
    "paper-p2",
    (
        Event("blackout", 6.0, 0.4),
        Event("blackout", 6.8, 0.3),
        Event("blackout", 9.5, 1.5),
        Event("blackout", 14.0, 3.0),
    ),
    duration=20.0,
    hold_max=2.0,
)


@pytest.mark.parametrize(
    ("breaks", "kind"),
    [
        (_holds_at_once, "hold"),
        (_resumes_at_once, "stale"),
        (_speeds_up, "cap"),
        (_chatters, "hold"),
        (_waits_for_ever, "hold"),
        (_lands_at_once, "hold"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__.strip("_"),
)
def test_a_guard_that_ends_a_hold_otherwise_is_found(
    breaks: Any, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    breaks(monkeypatch)
    assert kind in fly(HELD).kinds


def test_the_same_flight_with_the_current_guard_has_no_breach() -> None:
    assert fly(HELD).breaches == ()
