# SPDX-License-Identifier: Apache-2.0

"""What teleop says reaches the robot in its own session only; an emergency stop in any."""

from types import SimpleNamespace

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.flight.assembly.link import build_links
from cloudrc.flight.virtual.flight import assemble
from cloudrc.teleop.wire import ALARM
from cloudrc.wire.messages import GuardState, OperatorRequest, Request, Setpoint, Start
from cloudrc.wire.records import UNDER_WAY, Counted, GuardChange, MissionEvent
from cloudrc.wire.tunnel.codec import Kind, peek
from tests.flights.conftest import HOVER, both_ways, fly_on

S = 1_000_000_000
ELSEWHERE = (5.0, 5.0, 1.0)
ESTOP = GuardState.ESTOP


def join(experiment=HOVER):
    """Assemble both ends and their flight."""
    _, cloud, _, run = assemble(experiment)
    return SimpleNamespace(cloud=cloud, run=run)


def states(ends, seconds):
    """Fly on for some time [s]; return the new states of the guard."""
    of_world, _ = fly_on(ends.run, ends.run.now_ns + round(seconds * S))
    return [record.state for record in of_world if isinstance(record, GuardChange)]


@pytest.fixture
def ends():
    """Provide ends in flight."""
    ends = join()
    fly_on(ends.run, 4 * S)
    ends.cloud.take_datagrams()
    return ends


def say(ends, *words):
    """Return the kinds of the datagrams that cloud sends at once."""
    ends.cloud.teleop.outputs.extend(words)
    ends.cloud._take_from_teleop()
    return [peek(data)[0] for data in ends.cloud.take_datagrams()]


def test_setpoints_and_starts_are_for_their_own_session(ends):
    """Teleop is slow; in the meantime another cloud may have moved the robot."""
    epoch, before = ends.cloud._session.epoch, ends.cloud._setpoint
    setpoint, start = Setpoint(ELSEWHERE), OperatorRequest(99, Request.START)
    for said in (setpoint, start, start._replace(start=Start.SPAWN)):
        assert say(ends, said._replace(epoch=epoch - 1), said._replace(epoch=epoch + 1)) == []
    assert ends.cloud._setpoint is before
    assert ends.cloud.counts["words_dropped"] == 6
    assert say(ends, start, start._replace(epoch=epoch)) == [Kind.OPERATOR] * 2
    for said in (setpoint, setpoint._replace(epoch=epoch)):
        say(ends, said)
        assert ends.cloud._setpoint == said


def test_requests_that_arm_nothing_are_always_passed_on(ends):
    old = ends.cloud._session.epoch - 1
    said = [OperatorRequest(99, each, epoch=old) for each in Request if each != Request.START]
    assert say(ends, *said) == [Kind.OPERATOR] * len(said)
    ends.cloud._loop.reset(ends.run.now_ns)  # as a new session does: no telemetry yet
    start, stop = OperatorRequest(99, Request.START), OperatorRequest(99, Request.END)
    assert (say(ends, start), say(ends, stop)) == ([], [Kind.OPERATOR])


@pytest.mark.promise("emergency-stop-gets-through")
@pytest.mark.parametrize("seed", range(1, 6))
def test_a_link_that_loses_most_loses_no_alarm(seed):
    ends = join(load_experiment("hover", ["link.profile=ideal", f"seed={seed}"]))
    fly_on(ends.run, 4 * S)
    lossy = ["link.profile=ideal", *both_ways(loss=0.8), f"seed={seed}"]
    ends.run._uplink, ends.run._downlink = build_links(load_experiment("hover", lossy))
    ends.cloud.teleop.outputs.append(ALARM)
    assert states(ends, 4)[-1] is ESTOP


def test_an_acknowledgement_ends_one_alarm_not_the_next_stop(ends):
    teleop = ends.cloud.teleop
    teleop.outputs.append(ALARM)
    assert states(ends, 1) == [ESTOP]
    teleop.acknowledge()
    teleop.handle_deadline(5 * S)
    teleop.stop(5 * S)  # the robot still shows the first stop
    assert states(ends, 1)[-1] is ESTOP
    teleop.stop(6 * S)  # of a robot that is stopped
    assert states(ends, 1) == []
    assert teleop.settled
    teleop.outputs.append(ALARM)  # late, of before
    teleop.requests.ask(Request.ACKNOWLEDGE)
    assert states(ends, 2)[-1] is GuardState.GROUND


def test_cloud_counts_as_a_mission_begins_and_ends(ends):
    """The counters of the flight are then known to the period."""
    ends.cloud.take_records()
    for event in UNDER_WAY[1:]:
        say(ends, MissionEvent(7, event, 0, ""))
    assert not [one for one in ends.cloud.take_records() if isinstance(one, Counted)]
    for stamp_ns, event in enumerate(("started", "done")):
        say(ends, MissionEvent(stamp_ns, event, 0, ""))
        found = [one for one in ends.cloud.take_records() if isinstance(one, Counted)]
        assert {one.name: one.total for one in found} == ends.cloud.counts
        assert {one.stamp_ns for one in found} == {stamp_ns}
