"""Fault F5 counts changes between TRACK and HOLD; a start from the ground is the operator's."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cloudrc.faults.asks import busiest_second
from cloudrc.messages import GuardState
from cloudrc.records import GuardChange

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


@pytest.mark.parametrize(
    ("states", "most"),
    [
        ((), 0),
        ((GROUND, TRACK, GROUND, TRACK), 0),
        ((GROUND, TRACK, GROUND, TRACK, HOLD), 1),
        ((GROUND, TRACK, HOLD, TRACK, HOLD), 3),
        ((TRACK, HOLD, LAND), 1),
    ],
)
def test_only_changes_between_track_and_hold_count(
    states: tuple[GuardState, ...], most: int
) -> None:
    changes = [GuardChange(100_000_000 * i, state, "") for i, state in enumerate(states)]
    assert busiest_second(SimpleNamespace(changes=changes)) == most  # type: ignore[arg-type]
