"""The alarm: cloud repeats an emergency stop until the guard is in ESTOP."""

from cloudrc.cloud.operator import REPEAT_NS, EmergencyStopRepeater
from cloudrc.messages import GuardState, OperatorRequest, Request

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
