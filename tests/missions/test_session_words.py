"""Cloud's end: what teleop has said for one session does not lead the robot in the next."""

from __future__ import annotations

import pytest
from flying import Ends, join

from cloudrc.config.load import load_experiment
from cloudrc.messages import OperatorRequest, Request, Setpoint
from cloudrc.tunnel.codec import Kind, peek

HOVER = load_experiment("hover", ["link.profile=ideal"])
S = 1_000_000_000
ELSEWHERE = (5.0, 5.0, 1.0)


@pytest.fixture
def ends() -> Ends:
    """In flight."""
    ends = join(HOVER)
    ends.run.fly(lambda: False, 4 * S, lambda world, cloud: None)
    ends.cloud.take_datagrams()
    return ends


def say(ends: Ends, *words: Setpoint | OperatorRequest) -> list[int]:
    """Kinds of what cloud sends at once."""
    ends.cloud.teleop.outputs.extend(words)
    ends.cloud._take_from_teleop()
    return [peek(data)[0] for data in ends.cloud.take_datagrams()]


@pytest.mark.promise("P-MISSION-8")
def test_a_setpoint_for_another_session_is_not_flown(ends: Ends) -> None:
    epoch = ends.cloud._session.epoch
    before = ends.cloud._setpoint
    say(ends, Setpoint(ELSEWHERE, epoch=epoch - 1), Setpoint(ELSEWHERE, epoch=epoch + 1))
    assert ends.cloud._setpoint is before
    for mine in (Setpoint(ELSEWHERE, epoch=epoch), Setpoint(ELSEWHERE)):
        say(ends, mine)
        assert ends.cloud._setpoint == mine


@pytest.mark.promise("P-MISSION-8")
def test_nothing_starts_in_a_session_before_the_robot_is_seen_in_it(ends: Ends) -> None:
    start, end = (OperatorRequest(99, request) for request in (Request.START, Request.END))
    assert say(ends, start) == [Kind.OPERATOR]
    ends.cloud._loop.reset()  # as a new session does
    assert say(ends, start) == []
    assert say(ends, end) == [Kind.OPERATOR]
