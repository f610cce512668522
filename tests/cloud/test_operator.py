"""The alarm: cloud repeats an emergency stop until the guard is in ESTOP."""

from cloudrc.cloud.operator import REPEAT_NS, EmergencyStopRepeater
from cloudrc.messages import GuardState, OperatorRequest, Request

ESTOP, TRACK = GuardState.ESTOP, GuardState.TRACK


def sounding():
    alarm = EmergencyStopRepeater()
    alarm.sound()
    return alarm


def test_an_alarm_sends_nothing_before_it_starts():
    assert EmergencyStopRepeater().due(3, 10**18) is None


def test_an_alarm_repeats_one_number_until_the_guard_stops():
    alarm = sounding()
    first = alarm.due(3, 50)
    assert first == OperatorRequest(4, Request.ESTOP)
    assert alarm.due(4, 50 + REPEAT_NS - 1) is None
    alarm.see(TRACK, 3)
    assert alarm.due(4, 50 + REPEAT_NS) == first
    alarm.see(ESTOP, 4)
    assert alarm.due(4, 10**18) is None


def test_an_alarm_gets_a_new_number_if_its_own_is_taken():
    """World acts on rising numbers only."""
    alarm = sounding()
    alarm.due(3, 0)
    alarm.see(TRACK, 4)  # a start with a number of teleop
    assert alarm.due(4, REPEAT_NS).number == 5


def test_an_alarm_stays_above_later_requests():
    alarm = sounding()
    alarm.due(3, 0)
    assert alarm.due(7, REPEAT_NS).number == 8


def test_an_alarm_can_start_again_after_its_end():
    alarm = sounding()
    alarm.due(3, 0)
    alarm.sound()
    assert alarm.due(4, REPEAT_NS // 2) is None
    alarm.see(ESTOP, 4)
    alarm.see(GuardState.GROUND, 5)
    alarm.sound()
    assert alarm.due(5, REPEAT_NS // 2) == OperatorRequest(6, Request.ESTOP)
