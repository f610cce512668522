"""A journal of which an entry is lost: what the others say of a mission still counts."""

from __future__ import annotations

import pytest

from cloudrc.teleop.store import MissionStore, first_verb
from cloudrc.teleop.wire import Continue, StartMission
from tests.teleop.conftest import B, service_flying


@pytest.mark.parametrize("lost", [("started",), ("starting", "started")])
def test_a_mission_with_a_flight_entry_has_started(lost: tuple[str, ...]) -> None:
    """It is gone on with, or ends as the robot has; it does not wait for its turn."""
    flight, mission_id = service_flying()
    flight.step(position=B, seconds=0.1)
    damaged = [entry for entry in flight.kept if entry.get("event") not in lost]
    mission = MissionStore(lambda entry: None, damaged, b"").find(mission_id)
    assert mission.state == "flying"
    assert mission.reached
    assert isinstance(first_verb(mission), Continue)


def test_one_that_was_only_asked_to_start_has_not() -> None:
    flight, mission_id = service_flying()
    asked = [entry for entry in flight.kept if entry.get("event") in (None, "starting")]
    mission = MissionStore(lambda entry: None, asked, b"").find(mission_id)
    assert mission.state == "starting"
    assert isinstance(first_verb(mission), StartMission)
