# SPDX-License-Identifier: Apache-2.0

"""Current metrics of a process: histograms and counts of a flight, peer, mission, absent values."""

import json
import math

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.results.exposition import table
from cloudrc.results.exposition.live import LiveMetrics
from cloudrc.wire.messages import ZERO, Cause, GuardState
from cloudrc.wire.records import (
    Arrival,
    CommandApplied,
    Contact,
    ContactForce,
    FrameSent,
    GuardChange,
    Lateness,
    LinkChecked,
    MissionEvent,
    SensorLabel,
    SensorRead,
    SessionOpened,
)
from tests.doors.console.conftest import control
from tests.flights.conftest import records
from tests.support.told import told

MS = 1_000_000


def seen(role, *records):
    live = LiveMetrics(role)
    live.see(records)
    return live


def value(live, name, *label_values):
    return live.read()[name][label_values]


def wake(at_ms):
    return Lateness(at_ms * MS, "world", 1e-4, 2e-4, 0)


@pytest.mark.promise("unknown-is-absent")
def test_without_a_shared_clock_one_way_delays_are_absent():
    experiment = load_experiment("hover", ["link.profile=paper-p1", "cloud.clock_offset_s=7"])
    both = records(experiment)
    for role, of_end in zip(table.ENDS, both, strict=True):
        found = seen(role, *of_end).read()
        assert not any("age_of" in name or "link_delay" in name for name in found)
    assert found["cloudrc_rtt_seconds"].cumulative()[-1] > 100  # needs no shared clock


def test_command_age_is_that_of_its_odometry_in_track():
    """It needs no shared clock; on the ground and in HOLD no command is in use."""
    guards = (GuardState.GROUND, GuardState.TRACK, GuardState.HOLD)
    applied = CommandApplied(90 * MS, 1, 1, 10 * MS, ZERO)
    live = seen("world", applied, *(told(100 * MS, guard) for guard in guards))
    age = live.read()["cloudrc_command_age_seconds"]
    assert (age.cumulative()[-1], age.total) == (1, pytest.approx(0.09))


def test_pictures_tell_how_long_they_took():
    taken = (FrameSent(k, 1, k, k, k * 10 * MS, k, 1, 9, True, 40.0) for k in (1, 3))
    found = seen("world", *taken).read()["cloudrc_camera_seconds"]
    assert (found.cumulative()[-1], found.total) == (2, pytest.approx(0.04))


def test_control_periods_give_delays_errors_and_terms():
    known = {"setpoint": (1.0, 2.0, 3.0), "measured": (0.0, 2.5, 3.0)}
    periods = (control(0.01 * k, **known, derivative=(0.0, 0.0, -0.7)) for k in range(5))
    found = seen("cloud", *periods).read()
    errors = {("x",): 1.0, ("y",): -0.5, ("z",): 0.0}
    assert found["cloudrc_tracking_error_meters"] == errors
    assert found["cloudrc_pid_output"]["derivative", "z"] == -0.7
    assert "cloudrc_estimate_error_meters" not in found, "no prediction compared yet"


def test_guard_and_contacts_are_counted():
    assert value(LiveMetrics("world"), "cloudrc_guard_state") == GuardState.GROUND
    states = (GuardState.TRACK, GuardState.HOLD, GuardState.LAND, GuardState.LAND)
    touched = (Contact(0, body, ZERO, ZERO, ZERO, True) for body in ("board", "chair", "chair"))
    live = seen("world", *(GuardChange(0, state, "") for state in states), *touched)
    assert value(live, "cloudrc_guard_state") == GuardState.LAND
    for state in ("hold", "land"):  # a touch-down repeats LAND
        assert value(live, "cloudrc_guard_transitions_total", state) == 1
    assert live.read()["cloudrc_contacts_total"] == {("board",): 1, ("chair",): 2}


def test_each_own_sensor_of_the_robot_has_a_value_and_a_robot_without_has_none():
    live = LiveMetrics("world")
    assert "cloudrc_sensor_value" not in live.read()
    live.see([SensorRead(0, "battery", "V", 11.9), SensorRead(0, "range", "m", math.nan)])
    live.see([SensorRead(1, "battery", "V", 11.8), ContactForce(1, 0.5, 0.6, 0.0)])
    assert live.read()["cloudrc_sensor_value"] == {("battery", "V"): 11.8}
    live.see([ContactForce(2, 0.5, 0.6, 0.0, SensorLabel("tip", "N"))])
    assert value(live, "cloudrc_sensor_value", "tip", "N") == 0.5


def test_changes_of_the_guard_are_counted_by_cause():
    hold = GuardState.HOLD, Cause.SILENCE
    reasons = [(GuardState.GROUND, Cause.SPAWN), (GuardState.TRACK, Cause.COMMAND), hold, hold]
    reasons += [(GuardState.TRACK, Cause.COMMANDS), hold]
    live = seen("world", *(told(0, guard, cause=cause) for guard, cause in reasons))
    causes = live.read()["cloudrc_guard_causes_total"]
    counted = {cause: number for (cause,), number in causes.items() if number}
    assert counted == {"fresh command": 1, "no fresh commands": 2, "fresh commands again": 1}


def heard(role, *records):
    return seen(role, *records).end.has_peer


def opened(role, at_ms, epoch):
    return SessionOpened(at_ms * MS, role, epoch, "")


def arrived(role, at_ms, counter=0):
    return Arrival(at_ms * MS, role == "cloud", 1, counter, math.nan, True)


@pytest.mark.parametrize("role", table.ENDS)
def test_an_end_has_a_peer_while_datagrams_arrive(role):
    session = opened(role, 0, 1)
    arrival = arrived(role, 1000)
    assert not heard(role)
    assert not heard(role, wake(0))
    assert heard(role, session, wake(10))
    # Until cloud's first command, world's session itself counts as a peer.
    assert heard(role, session, wake(60_000)) == (role == "world")
    assert heard(role, session, arrival, wake(2900))
    assert not heard(role, session, arrival, wake(3100))
    assert heard(role, session, arrival, opened(role, 5000, 2), wake(5010))


@pytest.mark.parametrize("role", table.ENDS)
@pytest.mark.parametrize(("behind", "hears"), [(0, False), (1, True), (500, False)])
def test_a_replayed_datagram_is_no_sign_of_life(role, behind, hears):
    """Replaying a captured datagram needs no key; a late one that is new does count."""
    first, newest = (arrived(role, 100, counter) for counter in (0, 600))
    again = newest._replace(stamp_ns=2000 * MS, counter=600 - behind, used=False)
    assert heard(role, opened(role, 0, 1), first, newest, again, wake(2500)) == hears


EVENTS = [
    ("started", 0, "flying", 0),
    ("reached", 0, "flying", 1),
    ("held", 1, "held", 1),
    ("resumed", 1, "flying", 1),
    ("reached", 1, "flying", 2),
    ("done", 1, "done", -1),
    ("started", 0, "flying", 0),
    ("leg_timed_out", 0, "failed", -1),
]
"""Event and its waypoint, then the state and the next waypoint."""


def test_mission_metrics_follow_the_events():
    live = LiveMetrics("teleop")
    for event, at, state, waypoint in EVENTS:
        live.see([MissionEvent(0, event, at, "")])
        assert table.MISSION_STATES[int(value(live, "cloudrc_mission_state"))] == state
        assert value(live, "cloudrc_mission_waypoint") == waypoint
    assert value(live, "cloudrc_waypoints_reached_total") == 2
    assert value(live, "cloudrc_missions_total", "done") == 1
    assert value(live, "cloudrc_missions_total", "leg_timed_out") == 1


def test_the_newest_verdict_on_the_link_is_exposed():
    live = LiveMetrics("cloud")
    for stamp_ns, verdict, believed in ((1, "open", None), (2, "ok", 1.0), (2, "off", 0.0)):
        live.see([LinkChecked(stamp_ns, True, "mean", 0.04, math.nan, 0.03, 0.05, verdict, 900)])
        found = None if believed is None else {("uplink",): believed}
        assert live.read().get("cloudrc_link_believed") == found
    document = json.loads(live.end.link_text())
    assert (document["verdict"], len(document["rows"])) == ("off", 2)
    assert "measured" not in document["rows"][0], "an unknown value is left out"
