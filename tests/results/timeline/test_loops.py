# SPDX-License-Identifier: Apache-2.0

"""What a timeline shows beside the commands: the mission, and telemetry that was lost."""

from cloudrc.results.timeline.loops import MISSION, Phase, of_flight
from cloudrc.wire.records import Arrival, MissionEvent
from tests.results.metrics.conftest import DONE, SECOND, START, at, flown


def test_a_mission_lasts_until_its_end_and_not_until_its_first_waypoint():
    log = flown()
    log.cloud.append(MissionEvent(at(4), "reached", 0, "waypoint 1 reached"))
    mission = Phase(MISSION, START - SECOND, DONE, "mission: done")
    assert of_flight(log.flight()).phases == (mission,)


def test_telemetry_is_lost_if_later_telemetry_arrived_and_may_else_be_under_way():
    log = flown()
    last = max(each.counter for each in log.cloud if isinstance(each, Arrival))
    missing = (100, last)
    log.change(Arrival, lambda _, row: None if row.uplink and row.counter in missing else row)
    texts = [mark.text for mark in of_flight(log.flight()).marks if mark.text.endswith("lost")]
    assert texts == ["telemetry #100 lost"]
