"""A kill of cloud anywhere in the paper's mission: the robot holds, a new process continues."""

from math import hypot

import pytest

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight
from cloudrc.geometry.clearance import pipe_index
from cloudrc.geometry.scene import load_scene
from cloudrc.records import SessionOpened
from tests.flights.conftest import DAILY, DAILY_ANYWHERE, REST, REST_ANYWHERE, SLOW, mid_pipe

AWAY = 3.0
"""Time until there is a new process [s]."""
SAMPLE = 0.01
"""Time between two samples of the robot's position [s]."""


def fly_and_kill(at):
    """Kill cloud; the new process knows nothing of the old one.

    With the index of the pipe that the base was in at the kill, -1 for none.
    """
    flight, places = Flight(*SLOW), []

    def kill(now_ns):
        places.append(flight.robot.simulator.readings.position)
        flight.kill_cloud(now_ns, AWAY)

    flight.cloud.at(at, kill)
    flight.fly_mission(200.0)
    (pipe,) = pipe_index(load_scene(flight.experiment.world.scene), places).tolist()
    return flight, pipe


def calm_after(flight, start, end):
    """Return when the robot was last too fast to count as standing [s]."""
    fast = [
        time
        for record in flight.trajectory()
        if start <= (time := record.stamp_ns * 1e-9) < end
        and hypot(*record.odometry.velocity) >= measures.STANDS
    ]
    return fast[-1] + SAMPLE - start if fast else 0.0


def greeted_after(flight, back):
    """Return how many sessions world has opened since then."""
    opened = [r for r in flight.of_world if isinstance(r, SessionOpened) and r.end == "world"]
    return sum(r.stamp_ns >= back * 1e9 for r in opened)


def check_kill(figure, at, where="anywhere"):
    (flight, pipe), back = fly_and_kill(at), at + AWAY
    (hold,) = measures.held(flight)
    held = hold.stamp_ns * 1e-9
    basis_age = measures.basis_age_at_hold(flight)
    calm = calm_after(flight, held, back)
    resumed = measures.resumed_after(flight, back)
    for name, measured, asked, unit in (
        ("HOLD after, age of the basis", basis_age, 0.252, "s"),
        ("below 0.05 m/s after", calm, 1.0, "s"),
        ("in TRACK after the new one's start", resumed, 1.0, "s"),
        ("breaches", flight.watch.counts.total(), 0, ""),
    ):
        figure(f"cloud process killed {where}, 1.5 m/s: {name}", measured, "<=", asked, unit)
    assert flight.generations == {"world": 1, "cloud": 2}
    assert greeted_after(flight, back) == 1
    assert at < held <= at + 0.252
    assert 0.250 < basis_age <= 0.252 + 1e-9
    assert calm <= 1.0
    assert resumed <= 1.0
    assert flight.watch.counts == {}, flight.watch.breaches
    waypoints = range(len(flight.mission.order.plan.legs))
    assert [event.waypoint for event in flight.events("reached")] == list(waypoints)
    assert flight.mission.state == "done"
    return pipe


def check_kill_mid_pipe(figure, k):
    at, pipe = mid_pipe(*SLOW)[k]
    assert check_kill(figure, at, "mid-pipe") == pipe


@pytest.mark.promise("brakes-without-commands")
@pytest.mark.parametrize("k", DAILY)
def test_a_new_cloud_flies_on_after_a_kill(k, figure):
    check_kill_mid_pipe(figure, k)


@pytest.mark.full
@pytest.mark.parametrize("k", REST)
def test_killed_at_any_instant_a_new_cloud_flies_on(k, figure):
    check_kill_mid_pipe(figure, k)


@pytest.mark.parametrize("at", DAILY_ANYWHERE)
def test_killed_outside_of_the_pipes_a_new_cloud_flies_on_too(at, figure):
    assert check_kill(figure, at) == -1


@pytest.mark.full
@pytest.mark.parametrize("at", REST_ANYWHERE)
def test_killed_anywhere_a_new_cloud_flies_on(at, figure):
    check_kill(figure, at)
