"""Flights in virtual time: the robot stores its mission's progress, and a stuck leg fails."""

from cloudrc import assembly
from cloudrc.config.schema import Mission
from cloudrc.messages import Request, Start
from cloudrc.records import TelemetrySent
from tests.flights.conftest import Bare, ring

ID = 2**62 + 5


def ask(talk, request, number=0, *, start=Start.HERE, **fields):
    """Return the mission and the progress that the robot shows after a request."""
    talk.send(talk.speaker.ask(number, request, start, basis_ns=talk.now_ns, **fields))
    talk.wait(20)
    telemetry = talk.take(TelemetrySent)[-1].telemetry
    return telemetry.mission_id, telemetry.reached


def test_progress_rises_and_belongs_to_the_mission_started_last():
    talk = Bare(ring(), flies=True)
    talk.hello("cloud")
    for expected, request, number, fields in (
        ((0, 0), Request.PROGRESS, 0, {"mission_id": ID, "reached": 3}),
        ((ID, 0), Request.START, 1, {"mission_id": ID}),
        ((ID, 2), Request.PROGRESS, 0, {"mission_id": ID, "reached": 2}),
        ((ID, 2), Request.PROGRESS, 0, {"mission_id": ID, "reached": 1}),
        ((ID, 2), Request.PROGRESS, 0, {"mission_id": ID + 1, "reached": 9}),
        ((ID, 2), Request.END, 2, {}),
        ((ID, 2), Request.START, 3, {"mission_id": ID}),  # the same mission continues
    ):
        assert ask(talk, request, number, **fields) == expected
    talk.wait(2_000)  # the first cloud is not fresh any more
    talk.hello("another")
    assert ask(talk, Request.END, 1) == (ID, 2)
    assert ask(talk, Request.START, 2, mission_id=ID + 1) == (ID + 1, 0)
    ask(talk, Request.PROGRESS, mission_id=ID + 1, reached=2)
    # From the spawn a mission begins anew.
    assert ask(talk, Request.START, 3, mission_id=ID + 1, start=Start.SPAWN) == (ID + 1, 0)


def test_the_limit_of_a_leg_defaults_to_three_times_its_time():
    points = [{"position_m": (0.0, 0.0, 1.0)}, {"position_m": (3.0, 4.0, 1.0), "dwell_s": 2.0}]
    points.append({**points[1], "time_limit_s": 7.5})
    mission = Mission.model_validate({"start": "here", "waypoints": tuple(points)})
    for options, second in (({}, 33.0), ({"speed_max": 0.5}, 48.0)):
        legs = assembly.mission_plan(mission, 60.0, **options).legs
        assert [leg.time_limit for leg in legs][1:] == [second, 7.5]
