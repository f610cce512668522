# SPDX-License-Identifier: Apache-2.0

"""Cloud is silent or killed while the robot is in a pipe: it holds, then finishes the mission."""

from functools import cache

import numpy as np
import pytest

from cloudrc.physics.geometry.clearance import inside_tube
from cloudrc.physics.geometry.scene import load_scene
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import GroundTruth
from tests.conftest import nightly_rows
from tests.faults import measures
from tests.faults.flight import FaultRun
from tests.faults.schedule import FaultEvent, Schedule

COUNT = 200
SLOW = ("cloud.controller.speed_max=1.5",)
LONG = "criteria.time_limit_s=200"
PATIENCE = (LONG, *(f"mission.waypoints.{k}.time_limit_s=200" for k in range(7)))
KILLED, SILENT, SILENT_DAILY = 3.0, 60.5, 10.0
"""Time until a new process starts, or the link returns [s]; another test holds for a minute daily.
"""
ROUNDING = 1e-9
"""Of nanoseconds that were converted to seconds [s]."""


@cache
def undisturbed(*settings):
    return FaultRun(Schedule(1, hold_max=100.0), *PATIENCE, *settings).fly_mission()


@cache
def mid_pipe(*settings):
    """200 instants [s], evenly over the time in which the undisturbed robot is in a pipe."""
    flight = undisturbed(*settings)
    path = flight.of(GroundTruth)
    places = np.array([record.odometry.position for record in path])
    pipes = inside_tube(load_scene("pipes"), places)
    ended = flight.events("done")[0].stamp_ns * 1e-9 - 0.1
    inside = [r.stamp_ns * 1e-9 for r, pipe in zip(path, pipes, strict=True) if pipe]
    early = [time for time in inside if time < ended]
    return [early[round(k)] for k in np.linspace(0, len(early) - 1, COUNT)]


def interrupt(kill, at, *settings, calm=1.0, silent=SILENT):
    """Kill cloud's process, of which the new one knows nothing; or silence the link."""
    event = FaultEvent("cloud_killed", at, KILLED) if kill else FaultEvent("blackout", at, silent)
    back = at + event.duration
    flight = FaultRun(Schedule(1, events=(event,), hold_max=100.0), *PATIENCE, *settings)
    flight.fly_mission(200.0)
    waypoints = range(len(flight.mission.order.plan.legs))
    assert [event.waypoint for event in flight.events("reached")] == list(waypoints)
    assert flight.mission.state == "done"
    (hold,) = measures.held(flight)
    held, basis_age = hold.stamp_ns * 1e-9, measures.basis_age_at_hold(flight)
    tracked = measures.first_into(flight, GuardState.TRACK, back)
    assert at < held <= at + 0.252
    assert 0.250 < basis_age <= 0.252 + ROUNDING
    assert measures.calm_after(flight, held, back) <= calm + ROUNDING, "below 0.05 m/s"
    assert measures.drift(flight, held + calm, back) <= 0.10
    assert tracked - back <= 1.0 + ROUNDING
    assert not flight.breaches()
    assert flight.generations == {"world": 1, "cloud": 1 + kill}


@pytest.mark.promise("brakes-without-commands")
@pytest.mark.parametrize("kill", [False, True], ids=["silent", "killed"])
@pytest.mark.parametrize(
    ("k", "silent"), [(173, SILENT_DAILY), *nightly_rows(*((k, SILENT) for k in range(COUNT)))]
)
def test_without_its_cloud_the_robot_holds_in_a_pipe(k, silent, kill):
    interrupt(kill, mid_pipe()[k], calm=1.4, silent=silent)


@pytest.mark.full
@pytest.mark.parametrize("k", range(COUNT))
def test_without_its_cloud_the_slow_robot_holds_in_a_pipe(k):
    """With a cap on its speed it stops sooner."""
    interrupt(False, mid_pipe(*SLOW)[k], *SLOW)


def test_a_flight_without_faults_never_meets_the_fence():
    counts = undisturbed().world.inner.counts
    assert not [name for name in counts if name.startswith("limited")]
