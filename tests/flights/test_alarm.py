"""An emergency stop without teleop reaches the robot in any session and over a bad link."""

from __future__ import annotations

import pytest

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudIdentity
from cloudrc.config.load import load_experiment
from cloudrc.messages import GuardState, OperatorRequest, Request
from cloudrc.records import GuardChange
from cloudrc.teleop.wire import ALARM
from cloudrc.tunnel.codec import Kind, peek
from tests.flights.conftest import SHARED_CLOCK, Ends, join

HOVER = load_experiment("hover", ["link.profile=ideal"])
S = 1_000_000_000


def fly(ends: Ends, until_ns: int) -> list[GuardState]:
    """Continue the flight and return the states of the guard."""
    changes: list[GuardState] = []
    ends.run.fly(
        lambda: False,
        until_ns,
        lambda world, cloud: changes.extend(r.state for r in world if isinstance(r, GuardChange)),
    )
    return changes


def test_without_a_session_only_an_alarm_waits() -> None:
    cloud = assembly.build_cloud(HOVER, CloudIdentity(SHARED_CLOCK, b"cloud".ljust(16)))
    cloud.teleop.outputs += [OperatorRequest(3, Request.START), ALARM]
    for now_ns in range(0, S, 10_000_000):
        cloud.handle_deadline(now_ns)
    assert {peek(data)[0] for data in cloud.take_datagrams()} == {Kind.HELLO}


def test_an_early_alarm_keeps_the_robot_on_the_ground() -> None:
    ends = join(HOVER)
    ends.cloud.teleop.outputs.append(ALARM)
    states = fly(ends, 3 * S)
    assert states[-1] is GuardState.ESTOP
    assert GuardState.TRACK not in states
    assert states.count(GuardState.ESTOP) == 1


@pytest.mark.promise("emergency-stop-gets-through")
@pytest.mark.parametrize("seed", range(1, 6))
def test_a_link_that_loses_most_loses_no_alarm(seed: int) -> None:
    ends = join(load_experiment("hover", ["link.profile=ideal", f"seed={seed}"]))
    fly(ends, 4 * S)
    lossy = ["link.profile=ideal", "link.downlink.loss=0.8", "link.uplink.loss=0.8", f"seed={seed}"]
    ends.run._uplink, ends.run._downlink = assembly.build_links(load_experiment("hover", lossy))
    ends.cloud.teleop.outputs.append(ALARM)
    states = fly(ends, 8 * S)
    assert GuardState.ESTOP in states
    assert states[-1] is GuardState.ESTOP


def test_an_acknowledgement_ends_the_alarm() -> None:
    ends = join(HOVER)
    fly(ends, 4 * S)
    ends.cloud.teleop.outputs.append(ALARM)
    fly(ends, 5 * S)
    ends.cloud.teleop.requests.ask(Request.ACKNOWLEDGE)
    assert fly(ends, 9 * S) == [GuardState.GROUND]


def test_a_stop_after_an_acknowledgement_holds_and_one_before_is_undone() -> None:
    """The robot still shows the first stop, when the second is asked for."""
    ends = join(HOVER)
    fly(ends, 4 * S)
    ends.cloud.teleop.outputs.append(ALARM)
    fly(ends, 5 * S)
    ends.cloud.teleop.acknowledge(5 * S)
    ends.cloud.teleop.handle_deadline(5 * S)
    ends.cloud.teleop.stop(5 * S)
    assert fly(ends, 6 * S)[-1] is GuardState.ESTOP
    assert ends.cloud.teleop.settled
    ends.cloud.teleop.stop(6 * S)  # of a robot that is stopped
    assert fly(ends, 7 * S) == []
    assert ends.cloud.teleop.settled
    ends.cloud.teleop.outputs.append(ALARM)  # late, of before
    ends.cloud.teleop.requests.ask(Request.ACKNOWLEDGE)
    assert fly(ends, 9 * S)[-1] is GuardState.GROUND
