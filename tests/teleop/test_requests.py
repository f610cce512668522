"""Requests and the emergency stop: repeated until the robot has acted on them, and no others."""

from cloudrc.messages import GuardState, OperatorRequest, Request, Setpoint, Start
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.requests import PREDECESSORS, REPEAT_NS, RequestSender
from cloudrc.teleop.wire import ALARM, RobotStatus
from cloudrc.tunnel.codec import NUMBER_MAX
from tests.teleop.conftest import FROM_SPAWN, ID, A, Flight, flying

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


def first_request(seen, now_ns):
    sender = RequestSender()
    sender.see(seen, now_ns)
    sender.ask(Request.END)
    return sender.due(now_ns)


def test_whoever_begins_later_begins_higher_and_numbers_last():
    """Though both see a robot that has been asked nothing; for a thousand restarts."""
    seen = RobotStatus(1, A, GROUND, 0)
    numbers = [first_request(seen, REPEAT_NS * n).number for n in (5_000, 5_010, 0)]
    assert numbers == [PREDECESSORS + 5_000, PREDECESSORS + 5_010, PREDECESSORS]
    for _ in range(1_000):
        seen = seen._replace(mission=first_request(seen, 10 * 365 * 86_400 * 10**9).number)
    assert seen.mission < NUMBER_MAX / 10


def held_back(flight, number):
    """A start of the teleop before reaches the robot only now."""
    flight._obey(OperatorRequest(number, Request.START, Start.HERE, mission_id=ID))


def test_a_start_that_becomes_visible_later_is_ended():
    """Nobody flies that mission any more."""
    flight = Flight()
    flight.teleop = Teleop(ended=lambda number: number == ID)
    flight.step(seconds=0.5)
    assert flight.requests == []
    held_back(flight, 1)
    flight.step(seconds=0.1)
    assert flight.requests[-1].request is Request.END
    assert flight.guard is HOLD


def test_each_copy_of_a_setpoint_or_request_names_the_current_session():
    flight, said = Flight(), []
    flight.step()
    flight.operate("start", FROM_SPAWN, ID)
    for epoch in (1, 1, 2):
        flight.epoch = epoch
        flight.now_ns += REPEAT_NS
        flight.see()
        flight.teleop.handle_deadline(flight.now_ns)
        said += flight.teleop.take_outputs()
    requests = [each for each in said if isinstance(each, OperatorRequest)]
    assert len({(each.request, each.number) for each in requests}) == 1
    assert [each.epoch for each in requests] == [1, 1, 2]
    assert [each.epoch for each in said if isinstance(each, Setpoint)] == [2]


def test_a_stop_leaves_at_once_and_is_told_until_it_is_seen():
    """Cloud gives it a number, above all others, and repeats it towards the robot."""
    flight = flying()
    flight.uplink = False
    flight.operate("stop")
    assert flight.said[-1] == ALARM
    flight.step(seconds=1.0)
    assert 10 <= flight.said.count(ALARM) <= 11
    flight.uplink = True
    flight.step(seconds=0.5)
    assert flight.said.count(ALARM) <= 11
    assert flight.guard is ESTOP


def test_a_start_with_the_stops_number_does_not_confirm_the_stop():
    flight = Flight()
    flight.step()
    flight.downlink = False
    flight.operate("stop")
    flight.step(seconds=0.2)
    held_back(flight, flight.mission + 1)
    flight.step(seconds=0.05)
    assert flight.teleop.stopping
    flight.downlink = True
    flight.step(seconds=0.2)
    assert flight.guard is ESTOP
    assert flight.teleop.settled
