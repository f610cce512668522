# SPDX-License-Identifier: Apache-2.0

"""Missions as a service: keys, the queue, the operator's hand, restarts, and what is shown."""

import re
from math import dist, inf, nan

import pytest

from cloudrc.config.schema import Touch
from cloudrc.teleop.refusals import ConflictError
from cloudrc.teleop.store import Order
from cloudrc.teleop.view import NO_CLOUD, NOT_HEARD
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.messages import Cause, GuardState, Setpoint, Start
from tests.teleop.conftest import (
    AWAY,
    FROM_SPAWN,
    PLACES,
    A,
    B,
    ServiceFlight,
    flying,
    play,
    service_flying,
)

BOARD = Touch(body="board")
QUICK = Plan((Leg(A, dwell=0.0),), Start.HERE)
GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


def state(flight, mission_id="m1"):
    return flight.view(mission_id)["state"]


def failure(flight, mission_id="m1"):
    verdict = flight.view(mission_id)["verdict"]
    return verdict["failures"][0]["code"] if verdict and verdict["failures"] else ""


SCRIPTS = """
a flight: create 0.05 A B C -> states=done reached=0,1,2 guard=HOLD failure= settled=True over=True
held, moved, resumed: create 0.05 A !resume hold goto 0.05 resume !create B
  -> states=flying reached=0,1 last=reached asked=START
a held place: create 0.05 A mark hold goto 0.05 -> states=held setpoint=away:-1 asked= over=False
goto is a mission of its own: 0.05 goto 0.05 !goto !create away 0.6
  -> states=done name=goto guard=HOLD
both are cancelled: create 0.05 queue cancel cancelm1 !cancelm2 0.05
  -> states=cancelled,cancelled guard=HOLD failure=cancelled waypoint=-1
it begins once the disk works: create 0.05 queue cancelm1 full 3 free 1.5 -> states=cancelled,flying
a second mission waits: create 0.05 A !create queue queue B C A B C
  -> states=done,done,flying reached=0,1,2
between two missions the robot is seen to hold: create 0.05 A queue mute B C 1.0
  -> states=done,starting waypoint=-1 asked=END,START
world restarts: create 0.05 A world 0.05 -> failure=world_restarted waypoint=-1
the old world confirms no start from the spawn: mute create 0.05 guess 0.15 -> states=starting
the new world does: mute create 0.05 guess 0.15 link 0.15 -> states=flying
nothing starts: mute create 60 -> failure=timed_out
the guard holds: create 0.05 A HOLD 20 TRACK B -> states=flying reached=0,1
a stop by somebody else is not undone: create 0.05 A mark ESTOP 0.3
  -> failure=guard_stopped guard=ESTOP asked=END

# To stay at a waypoint for 0.5 s
dwell starts again outside of the tolerance: patient 0.05 A 0.4 near A 0.4 -> last=started
and then it counts: patient 0.05 A 0.4 near A 0.46 -> last=reached
time in hold or unseen is no dwell: patient 0.05 HOLD A 2 TRACK 0.4 stall -> reached=
and afterwards time counts: patient 0.05 HOLD A 2 TRACK 0.4 stall 0.6 -> reached=0

# The first setpoint: an armed robot flies to it at once
a start leads it away once it starts: mute create 0.05 cloud TRACK foreign away 0.3 link 0.3
  -> states=flying setpoint=A:0

# Another mission on board: who finds it does not fly on
taken over in flight: create 0.05 A foreign mark 0.3 -> failure=taken_over waypoint=-1 asked=
from here before the start: HOLD away restart mute here 0.1 cloud foreign TRACK B
  -> failure=taken_over setpoint=B:-1
its own, which it has not seen start, is nobody else's: 0.05 deaf create 60 link goto 0.3
  -> states=failed,flying
nor is the last but one: 0.05 deaf create 0.1 cancel goto cancel goto link 0.3
  -> states=cancelled,cancelled,flying
a lost mission does not take off: foreign mark 0.05 -> asked=END setpoint=floor:-1 settled=True

# Restarts of teleop
it continues at its waypoint: create 0.05 A away 5 mark restart see 0.05
  -> states=flying waypoint=1 asked=START last=resumed
with a full disk the robot remembers: create 0.05 A full B 0.1 restart free away C 0.1
  -> states=done reached=0,1,2 failure=
a flight never stored is not flown again: mute create full link 0.1 A B C 0.2 free restart mark 1
  -> states=failed failure=end_lost asked=END guard=HOLD reached=
nor is an end that the robot knows lost: create 0.05 A full B C 0.3 restart free away 0.3
  -> states=done reached=0,1,2 last=done
nor a robot taken that flies another mission: create 0.05 A TRACK foreign mark restart 0.3
  -> failure=taken_over asked=
it never flies back: create 0.05 A full B 0.1 mute restart free away -> states=flying waypoint=2
a lost cancel is not flown again: create 0.05 A full cancel 0.3 free mark restart away 1.0
  -> failure=end_lost guard=HOLD asked=END
a cancel right after it is one in flight: create 0.05 A restart cancel 0.3
  -> states=cancelled guard=HOLD onboard=65535
held stays held: create 0.05 A hold mark restart due restart away
  -> states=held setpoint=away:-1 led=-1
and is resumed: create 0.05 A hold restart away 0.05 resume 0.01 -> states=flying waypoint=1
time goes on: create 0.05 A away 10 B deaf restart 50 -> failure=timed_out
a landing without teleop: create 0.05 queue LAND restart see 0.2
  -> states=failed,queued failure=guard_stopped

# Restarts of cloud
cloud restarts: create 0.05 A mark cloud 0.3 -> states=flying asked= last=new_session waypoint=1

# Stops
a stop: create 0.05 A mark stop 0.05
  -> failure=emergency_stopped guard=ESTOP asked=ESTOP settled=True
the robot learns that it ended the mission: create 0.05 A stop 0.3 -> onboard=65535
an acknowledgement does as well: restart ack foreign mark 0.3 -> asked=ACKNOWLEDGE,END
a stop on its way forbids to start: create 0.05 queue mute stop 0.2 !queue !goto link 0.3
  -> states=failed,queued guard=ESTOP
until it is acknowledged: create 0.05 queue stop 0.3 !queue ack 0.5 !ack -> states=failed,flying
a landing has to be acknowledged, too: create 0.05 LAND 0.05 !create !goto ack 0.3 create 0.1
  -> states=failed,flying
a stop that was not heard is repeated: create 0.05 A mute stop 0.2 cloud restart !queue link 0.3
  -> guard=ESTOP failure=emergency_stopped
though acknowledged before: create 0.05 A mute restart stop 0.2 cloud restart !ack link 0.5
  -> guard=ESTOP last=emergency_stopped
not after an acknowledgement: create 0.05 A stop 0.2 ack 0.2 mark restart 0.5
  -> guard=HOLD asked=END
not in another world: create 0.05 A stop 0.2 world mark restart 0.5 -> guard=GROUND asked=
a stop before telemetry stops any flight: create 0.05 A TRACK foreign restart stop 0.2
  -> guard=ESTOP failure=emergency_stopped
a stop after an acknowledgement counts: create 0.05 A stop 0.2 ack stop 0.3
  -> guard=ESTOP last=emergency_stopped
the number of an acknowledgement does not confirm it: stop 0.3 ack 0.3 stop 0.3 mute ack 0.01 guess
  0.01 link 0.3 -> guard=GROUND
none while a stop is on its way: create 0.05 A mute stop !ack 0.2 !ack link 0.3 ack 0.2
  -> guard=GROUND

# Leases of 10 s
a watcher renews its lease: leased 9 renew 9 -> states=flying
a mission without its watcher is cancelled: leased 9 renew 10.5
  -> states=cancelled failure=cancelled guard=HOLD
also one that waits, and it is never flown: create 0.05 waiting 11
  -> states=flying,cancelled started=1
a new teleop gives the full lease again: leased 9 restart 9 -> states=flying
but no longer one: leased 9 restart 10.5 -> states=cancelled

# The link
a change of the link is in the log of the mission: create 0.05 change -> last=link_changed

# The end of teleop
in flight it holds: create 0.05 A away pause 0.5
  -> states=flying guard=HOLD last=paused setpoint=away:-1
also a new one holds: create 0.05 A mark restart pause 0.5 -> guard=HOLD asked=END settled=True
before the start nothing takes off: mute create link mark restart pause 0.5
  -> guard=HOLD asked=END settled=True
nothing is begun: create 0.05 A hold pause 0.2 mark !queue !goto !resume 0.5 -> states=held asked=
it still stops and releases: create 0.05 A pause 0.1 stop 0.1 ack 0.1
  -> guard=GROUND failure=emergency_stopped
"""
"""Name of a row, script of `play`, and what follows from it."""


def place(setpoint):
    return next((name for name, at in PLACES.items() if at == setpoint.position), "floor")


def outcome(flight):
    """Describe the state of a flight in words."""
    missions = list(flight.teleop.book.missions.values())
    requests = [said for said in flight.said[flight.mark :] if hasattr(said, "request")]
    names = flight.names("m1") if missions else []
    return {
        "states": [mission.state for mission in missions],
        "reached": [str(each["waypoint"]) for each in missions[0].reached] if missions else [],
        "guard": [flight.guard.name],
        "settled": [str(flight.teleop.settled)],
        "over": [str(flight.teleop.over)],
        "asked": sorted({said.request.name for said in requests} - {"PROGRESS"}),
        "setpoint": [f"{place(flight.setpoints[-1])}:{flight.setpoints[-1].waypoint}"],
        "waypoint": [str(flight.setpoints[-1].waypoint)],
        "led": sorted({str(s.waypoint) for s in flight.said[flight.mark :] if type(s) is Setpoint}),
        "onboard": [str(flight.onboard[1])],
        "last": names[-1:],
        "started": [str(sum(mission.happened["started"] for mission in missions))],
        "failure": [failure(flight)] if missions else [],
        "name": [missions[0].order.name] if missions else [],
    }


ROWS = re.findall(r"^(\w.*): (.*?)\s+-> (.*)$", SCRIPTS, re.M)


@pytest.mark.parametrize(("name", "script", "expected"), ROWS, ids=[row[0] for row in ROWS])
def test_what_follows_from_a_script(name, script, expected):
    flight = ServiceFlight()
    flight.step()
    play(flight, script)
    found = outcome(flight)
    for each in expected.split():
        key, _, value = each.partition("=")
        assert ",".join(found[key]) == value, key


@pytest.mark.parametrize(("downlink", "after"), [(True, 0.02), (False, 5.02)])
def test_a_mission_in_virtual_time_is_over_once_the_robot_knows_or_after_5_s(downlink, after):
    flight = flying()
    flight.downlink = downlink
    flight.teleop.cancel("m1", flight.now_ns)
    over = [(flight.step(), flight.teleop._teleop.over)[1] for _ in range(600)]
    assert over.index(True) * 0.01 == pytest.approx(after, abs=0.02)


@pytest.mark.parametrize("at", [B, AWAY])
def test_setpoints_end_on_time_and_tell_the_distance_from_the_last_one(at):
    track = ((0.0, A), (1.0, B), (2.0, B))
    flight = flying(Plan((Leg(A, tolerance=inf, time_limit=inf),), track=track))
    flight.step(position=B, seconds=1.8)
    assert state(flight) == "flying"
    flight.step(position=at, seconds=0.3)
    assert flight.names("m1")[-1] == "done"
    texts = " ".join(event.text for event in flight.events)
    assert f"{dist(at, B):.2f} m from the last one" in texts
    assert "waypoint" not in texts


@pytest.mark.parametrize(
    ("script", "codes", "words"),
    [
        ("deaf 60", ["timed_out", "no_telemetry"], "no telemetry for 60.0 s in all"),
        ("deaf 20 link 5 deaf 10 link 30", ["timed_out", "no_telemetry"],
         "no telemetry for 30.0 s in all"),
        ("HOLD 60", ["timed_out", "guard_held"], "the guard was in HOLD for 3.0 s in all"),
        ("deaf 2 link 1 HOLD 2 LAND 0.1", ["guard_stopped", "no_telemetry", "guard_held"], ""),
        ("deaf 5 link B C 0.1", [], ""),
    ],
)  # fmt: skip
def test_the_verdict_of_a_failed_mission_tells_its_interruptions(script, codes, words):
    flight, mission_id = service_flying()
    play(flight, script)
    failures = flight.view(mission_id)["verdict"]["failures"]
    told = [failure for failure in failures if failure["code"] != "waypoint_not_reached"]
    assert [failure["code"] for failure in told] == codes
    assert words in "; ".join(failure["text"] for failure in told)


@pytest.mark.fault(
    35,
    "job-twice",
    injects="the same mission is posted several times with the same key, also after a "
    "restart of teleop",
    expects="one mission; every client gets it",
    figures="4 orders",
)
def test_a_key_is_that_of_one_order_for_ever():
    flight, mission_id = service_flying(key="uid")
    play(flight, "A B C")
    for _ in range(2):
        assert flight.create(key="uid") == mission_id
        for order in (Order(QUICK, key="uid"), Order(FROM_SPAWN, key="uid", touch=BOARD)):
            with pytest.raises(ConflictError, match="mission m1 has the key 'uid' already"):
                flight.teleop.create(order, flight.now_ns)
        flight.restart_teleop()
    assert flight.create(key="another") == "m2"


@pytest.mark.parametrize(
    ("seen", "codes", "exit_code"),
    [
        ({"obstacle_contacts": 2, "touch_speed": 0.1}, ["obstacle_touched"], 1),
        ({"touch_speed": 0.3}, ["contact_too_fast"], 1),
        ({}, ["not_touched"], 1),
        ({"slip_ns": 1_000_000_000, "touch_speed": 0.1}, ["not_real_time"], 6),
        ({"touch_speed": 0.12}, [], 0),
    ],
)
@pytest.mark.parametrize("restarted", [False, True])
def test_what_the_robot_touched_decides(seen, codes, exit_code, restarted):
    """Also what it touched while teleop was away, but not the time that world lost then."""
    flight, mission_id = service_flying(touch=BOARD)
    if restarted:
        flight.restart_teleop()
        if "slip_ns" in seen:
            codes, exit_code = [], 0
    vars(flight).update(seen)
    flight.step(seconds=0.05)
    assert ("touched" in flight.names(mission_id)) == ("touch_speed" in seen)
    play(flight, "A B C")
    verdict = flight.view(mission_id)["verdict"]
    assert verdict["exit_code"] == exit_code
    assert [failure["code"] for failure in verdict["failures"]] == codes
    assert flight.teleop.failed == (verdict["outcome"] == "failure"), "its metric"


# What is shown


def shown(flight):
    return flight.teleop.state(flight.now_ns)["seen"]


def test_the_state_has_its_cause_and_its_duration():
    flight, _ = service_flying()
    flight.step(seconds=0.5)
    assert shown(flight)["guard_for_s"] > 0.5
    flight.guard, flight.cause, flight.downlink = HOLD, Cause.SILENCE, False
    flight.step()
    assert (shown(flight)["guard"], shown(flight)["guard_for_s"]) == ("HOLD", 0.0)
    flight.uplink = False
    flight.step(seconds=2.0)
    assert (shown(flight)["guard_for_s"], shown(flight)["cause"]) == (None, "no fresh commands")
    flight.uplink = True
    flight.step(position=(nan, 0.0, inf))
    assert shown(flight)["position_m"] == [None, 0.0, None], "JSON has no such numbers"


@pytest.mark.parametrize("values", [(11.9, nan), (11.9,), ()])
def test_the_state_names_the_sensors_and_says_nothing_about_those_of_another_robot(values):
    flight = ServiceFlight()
    flight.sensors = values
    flight.step()
    known = [("battery", 11.9, "V"), ("range", None, "m")] if len(values) == 2 else []
    names = "name", "value", "unit"
    assert shown(flight)["sensors"] == [dict(zip(names, each, strict=True)) for each in known]


def test_a_silent_robot_is_told_from_a_silent_cloud():
    flight = ServiceFlight()
    assert flight.teleop.state(0)["cloud_age_s"] is None
    for cloud, said in ((True, NOT_HEARD), (False, NO_CLOUD)):
        flight.step()
        flight.now_ns += 2_000_000_000
        if cloud:
            flight.teleop.hear(flight.now_ns)
        assert shown(flight)["next_step"] == said
