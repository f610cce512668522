# SPDX-License-Identifier: Apache-2.0

"""What cloud tells teleop, and the alarm: a stop is repeated until the guard is in ESTOP."""

import pytest

from cloudrc.cloud.operator import REPEAT_NS, EmergencyStopRepeater
from cloudrc.config.load import load_experiment
from cloudrc.flight.virtual.flight import assemble
from cloudrc.wire.messages import GuardState, OperatorRequest, Request

ESTOP, TRACK = GuardState.ESTOP, GuardState.TRACK


def test_an_alarm_repeats_one_number_until_the_guard_stops():
    alarm = EmergencyStopRepeater()
    assert alarm.due(3, 0) is None, "not before it starts"
    alarm.sound()
    first = alarm.due(3, 50)
    assert first == OperatorRequest(4, Request.ESTOP)
    alarm.sound()
    assert alarm.due(4, 50 + REPEAT_NS - 1) is None
    alarm.see(TRACK, 3)
    assert alarm.due(4, 50 + REPEAT_NS) == first
    alarm.see(ESTOP, 4)
    assert alarm.due(4, 10**18) is None
    alarm.see(GuardState.GROUND, 5)
    alarm.sound()
    assert alarm.due(5, 51 + REPEAT_NS) == OperatorRequest(6, Request.ESTOP), "it starts again"


def test_an_alarm_stays_above_all_other_requests():
    """World acts on rising numbers only."""
    alarm = EmergencyStopRepeater()
    alarm.sound()
    alarm.due(3, 0)
    alarm.see(TRACK, 4)  # a start with a number of teleop
    assert alarm.due(4, REPEAT_NS).number == 5
    assert alarm.due(7, 2 * REPEAT_NS).number == 8


def test_round_trip_and_uplink_of_a_status_give_the_downlink():
    ways = ["link.profile=ideal", "link.uplink.delay_ms=30", "link.downlink.delay_ms=10"]
    _, cloud, _, flight = assemble(load_experiment("hover", ways))
    statuses, see = [], cloud.teleop.see
    cloud.teleop.see = lambda status, now_ns: (statuses.append(status), see(status, now_ns))
    flight.fly(lambda: len(statuses) > 200, 10**10, lambda of_world, of_cloud: None)
    assert statuses[0].control is None
    last = statuses[-1]
    assert last.uplink_delay == pytest.approx(0.030, abs=1e-3)
    assert last.control.rtt - last.uplink_delay == pytest.approx(0.010, abs=1e-3)
