"""Flights in virtual time: the robot stores its mission's progress, and a stuck leg fails."""

from __future__ import annotations

import pytest

from cloudrc import assembly
from cloudrc.config.load import load_experiment
from cloudrc.config.schema import Mission, Waypoint
from cloudrc.messages import GuardState, OperatorRequest, Request, Start, Telemetry
from cloudrc.records import GuardChange, MissionEvent, TelemetrySent
from cloudrc.teleop.wire import ALARM
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Kind
from tests.flights.conftest import Talk, join, records

ID = 2**62 + 5


def test_the_robot_stores_every_waypoint_reached() -> None:
    world, cloud = records(load_experiment("paper"))
    reached = [r for r in cloud if isinstance(r, MissionEvent) and r.event == "reached"]
    shown = {}
    for record in world:
        if isinstance(record, TelemetrySent):
            shown.setdefault(record.telemetry.reached, record.stamp_ns)
    assert sorted(shown) == list(range(len(reached) + 1))
    for count, event in enumerate(reached, 1):
        assert shown[count] - event.stamp_ns < 300_000_000


class Operated(Talk):
    """A world that gets requests."""

    def ask(self, request: Request, number: int = 0, **what: int) -> Telemetry:
        what |= {"basis_stamp_ns": self.world_ns}
        asked = OperatorRequest(number, request, Start.HERE, **what)
        self.say(Kind.OPERATOR, codec.encode_operator(asked))
        self.wait(self.now_ns + 20_000_000)
        telemetry = [codec.decode_telemetry(body) for *_, body in self.hear(Kind.TELEMETRY)]
        return telemetry[-1]

    def say(self, kind: Kind, body: bytes) -> None:
        self.send(self.session.seal(kind, body))


@pytest.fixture
def talk() -> Operated:
    talk = Operated()
    talk.hello(b"cloud")
    return talk


def progress(telemetry: Telemetry) -> tuple[int, int]:
    return telemetry.mission_id, telemetry.reached


def test_progress_rises_and_belongs_to_the_mission_started_last(talk: Operated) -> None:
    ask = talk.ask
    assert progress(ask(Request.PROGRESS, mission_id=ID, reached=3)) == (0, 0)
    assert progress(ask(Request.START, 1, mission_id=ID)) == (ID, 0)
    assert progress(ask(Request.PROGRESS, mission_id=ID, reached=2)) == (ID, 2)
    assert progress(ask(Request.PROGRESS, mission_id=ID, reached=1)) == (ID, 2)
    assert progress(ask(Request.PROGRESS, mission_id=ID + 1, reached=9)) == (ID, 2)
    assert progress(ask(Request.END, 2)) == (ID, 2)
    assert progress(ask(Request.START, 3, mission_id=ID)) == (ID, 2)  # the same mission continues
    assert progress(ask(Request.START, 4, mission_id=ID + 1)) == (ID + 1, 0)


def test_from_the_spawn_a_mission_begins_anew(talk: Operated) -> None:
    """The old progress must not count, because the mission restarts at the spawn."""
    talk.ask(Request.START, 1, mission_id=ID)
    talk.ask(Request.PROGRESS, mission_id=ID, reached=2)
    again = OperatorRequest(2, Request.START, Start.SPAWN, ID)
    talk.say(Kind.OPERATOR, codec.encode_operator(again))
    talk.wait(talk.now_ns + 20_000_000)
    assert progress(talk.take(TelemetrySent)[-1].telemetry) == (ID, 0)


def test_progress_on_board_survives_a_restart_of_cloud(talk: Operated) -> None:
    talk.ask(Request.START, 1, mission_id=ID)
    talk.ask(Request.PROGRESS, mission_id=ID, reached=2)
    talk.wait(talk.now_ns + 2_000_000_000)  # the first one is not fresh any more
    talk.hello(b"another cloud")
    assert progress(talk.ask(Request.END, 1)) == (ID, 2)


def test_an_alarm_gets_a_number_that_world_acts_on() -> None:
    ends = join(load_experiment("hover", ["link.profile=ideal"]))
    world = []
    ends.run.fly(lambda: ends.run.now_ns >= 5_000_000_000, 6_000_000_000, lambda w, c: None)
    ends.cloud.teleop.outputs.append(ALARM)
    ends.run.fly(
        lambda: ends.run.now_ns >= 6_000_000_000, 7_000_000_000, lambda w, c: world.extend(w)
    )
    changes = [r.state for r in world if isinstance(r, GuardChange)]
    assert changes[0] is GuardState.ESTOP


def test_a_leg_that_takes_three_times_too_long_fails() -> None:
    """Its tolerance is below the sensor's noise, so the waypoint is never reached."""
    experiment = load_experiment(
        "hover",
        [
            "link.profile=ideal",
            "criteria.time_limit_s=100",
            "world.sensors.position_noise_m=0.2",
            "mission={start: spawn, waypoints: [{position_m: [0.5, 0, 0.7], tolerance_m: 1.5,"
            " dwell_s: 0}, {position_m: [0.5, 3.0, 0.7], tolerance_m: 0.01, dwell_s: 1.0}]}",
        ],
    )
    world, cloud = records(experiment)
    events = [r for r in cloud if isinstance(r, MissionEvent)]
    assert [e.event for e in events] == ["started", "reached", "leg_timed_out"]
    expected = 3.0 / assembly.CRUISE_SPEED + assembly.SETTLE_TIME + 1.0
    assert f"waypoint 2 of 2 not reached in {3 * expected:g} s" in events[-1].text
    took = (events[-1].stamp_ns - events[-2].stamp_ns) * 1e-9
    assert took == pytest.approx(3 * expected, abs=0.2)
    states = [r.state for r in world if isinstance(r, GuardChange)]
    assert states[-1] is GuardState.HOLD


def limits(mission: Mission, **options: float) -> list[float]:
    return [leg.time_limit for leg in assembly.mission_plan(mission, 60.0, **options).legs]


def test_the_limit_of_a_leg_defaults_to_three_times_its_time() -> None:
    points = [
        Waypoint(position_m=(0.0, 0.0, 1.0), dwell_s=0.0),
        Waypoint(position_m=(3.0, 4.0, 1.0), dwell_s=2.0),
        Waypoint(position_m=(3.0, 4.0, 1.0), dwell_s=0.0, time_limit_s=7.5),
    ]
    mission = Mission(start="here", waypoints=tuple(points))
    span = assembly.FENCE_SPAN
    assert limits(mission) == [round(3 * (span + 4.0), 1), 33.0, 7.5]
    assert limits(mission, speed_max=0.5)[1] == 48.0
    assert limits(mission, speed_max=9.0)[1] == 33.0
