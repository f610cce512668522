"""Cloud does not use setpoints and starts that teleop made for another session."""

from __future__ import annotations

import pytest

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudIdentity
from cloudrc.cloud.operator import Operator
from cloudrc.config.load import load_experiment
from cloudrc.messages import GuardState, OperatorRequest, Request, Setpoint, Start
from cloudrc.records import Fault, GuardChange, Record
from cloudrc.teleop.wire import ALARM, Output, RobotStatus
from cloudrc.tunnel.codec import NUMBER_MAX, Kind, peek
from cloudrc.world.endpoint import WorldIdentity
from tests.flights.conftest import SHARED_CLOCK, Ends, join

HOVER = load_experiment("hover", ["link.profile=ideal"])
S = 1_000_000_000
LAG_NS = 2 * S
ELSEWHERE = (5.0, 5.0, 1.0)


@pytest.fixture
def ends() -> Ends:
    """Provide ends in flight."""
    ends = join(HOVER)
    ends.run.fly(lambda: False, 4 * S, lambda world, cloud: None)
    ends.cloud.take_datagrams()
    return ends


def say(ends: Ends, *words: Setpoint | OperatorRequest) -> list[int]:
    """Return the kinds of the datagrams that cloud sends at once."""
    ends.cloud.teleop.outputs.extend(words)
    ends.cloud._take_from_teleop()
    return [peek(data)[0] for data in ends.cloud.take_datagrams()]


def test_a_setpoint_for_another_session_is_not_flown(ends: Ends) -> None:
    epoch = ends.cloud._session.epoch
    before = ends.cloud._setpoint
    say(ends, Setpoint(ELSEWHERE, epoch=epoch - 1), Setpoint(ELSEWHERE, epoch=epoch + 1))
    assert ends.cloud._setpoint is before
    assert ends.cloud._counts["words_dropped"] == 2
    for mine in (Setpoint(ELSEWHERE, epoch=epoch), Setpoint(ELSEWHERE)):
        say(ends, mine)
        assert ends.cloud._setpoint == mine


def test_nothing_starts_before_the_first_telemetry(ends: Ends) -> None:
    start, end = (OperatorRequest(99, request) for request in (Request.START, Request.END))
    assert say(ends, start) == [Kind.OPERATOR]
    ends.cloud._loop.reset()  # as a new session does
    assert say(ends, start) == []
    assert say(ends, end) == [Kind.OPERATOR]


def test_a_start_for_another_session_is_not_passed_on(ends: Ends) -> None:
    """Teleop is slow; in the meantime another cloud may have moved the robot."""
    epoch = ends.cloud._session.epoch
    for start in Start:
        said = OperatorRequest(99, Request.START, start)
        assert say(ends, said._replace(epoch=epoch - 1), said._replace(epoch=epoch + 1)) == []
        assert say(ends, said._replace(epoch=epoch)) == [Kind.OPERATOR]
        assert say(ends, said) == [Kind.OPERATOR], "for no session"
    assert ends.cloud._counts["words_dropped"] == 2 * len(Start)


def test_used_up_numbers_last_until_the_next_session(
    ends: Ends,
) -> None:
    """A sender with the keys has used the highest number of all."""
    cloud, run = ends.cloud, ends.run
    said = OperatorRequest(NUMBER_MAX, Request.END)
    assert say(ends, said) == [Kind.OPERATOR]
    assert say(ends, said._replace(number=NUMBER_MAX + 1), ALARM) == []
    run.fly(lambda: False, run.now_ns + S, lambda world, cloud: None)
    assert cloud._counts["words_dropped"] > 2
    identity = WorldIdentity(SHARED_CLOCK, b"another".ljust(16))
    world = assembly.build_world(HOVER, identity, lambda: run.now_ns)
    run._world = world
    run.fly(lambda: False, run.now_ns + 2 * S, lambda world, cloud: None)
    assert world.robot.guard.state is GuardState.ESTOP


@pytest.mark.parametrize("request_", [each for each in Request if each is not Request.START])
def test_requests_that_arm_nothing_are_always_passed_on(ends: Ends, request_: Request) -> None:
    epoch = ends.cloud._session.epoch
    said = OperatorRequest(99, request_, epoch=epoch - 1)
    assert say(ends, said, said._replace(epoch=epoch)) == [Kind.OPERATOR] * 2


class Lagging:
    """A teleop in its own process whose messages are late."""

    outcome, settled = None, True

    def __init__(self, teleop: Operator) -> None:
        self._teleop = teleop
        self._late: list[tuple[int, Output | Fault]] = []
        self.outputs: list[Output | Fault] = []
        self.epochs: dict[int, int] = {}  # epochs seen, and when first [ns]

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        self.epochs.setdefault(seen.epoch, now_ns)
        self._teleop.see(seen, now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        self._teleop.handle_deadline(now_ns)
        self._late += [(now_ns + LAG_NS, said) for said in self._teleop.take_outputs()]
        while self._late and self._late[0][0] <= now_ns:
            self.outputs.append(self._late.pop(0)[1])

    def take_outputs(self) -> list[Output | Fault]:
        outputs, self.outputs = self.outputs, []
        return outputs


def test_a_slow_teleop_starts_missions_in_the_session_it_saw() -> None:
    """Its first start is under way while cloud restarts, and arrives in the next session."""
    ends = join(HOVER)
    teleop = ends.cloud.teleop = Lagging(ends.cloud.teleop)
    changes: list[GuardChange] = []

    def note(world: list[Record], cloud: list[Record]) -> None:
        changes.extend(record for record in world if isinstance(record, GuardChange))

    ends.run.fly(lambda: False, LAG_NS - S // 2, note)
    ends.run._cloud = assembly.build_cloud(
        HOVER, CloudIdentity(SHARED_CLOCK, b"another".ljust(16)), lambda: ends.run.now_ns, teleop
    )
    ends.run.fly(lambda: False, 4 * LAG_NS, note)
    _, second, _ = teleop.epochs.values()  # the third is that of the start from the spawn
    assert changes[0].stamp_ns >= second + LAG_NS
    assert changes[-1].state is GuardState.TRACK
