"""Missions as a service: keys, the queue, the operator's hand, restarts, and what is shown."""

from argparse import Namespace
from types import SimpleNamespace

import pytest

from cloudrc.cli.teleop import _start, ending
from cloudrc.config.load import load_experiment
from cloudrc.drivers.teleop import serve_teleop, turn
from cloudrc.exposition.table import MISSION_OUTCOMES
from cloudrc.messages import MISSION_OVER, Cause, GuardState, Request, Setpoint, Start
from cloudrc.teleop import wire
from cloudrc.teleop.api import Bridge
from cloudrc.teleop.service import NO_CLOUD, NOT_HEARD, QUEUE_MAX, SILENCE, next_step
from cloudrc.teleop.store import ENDED, SHOWN, STATES, ConflictError, Order, UnavailableError
from cloudrc.teleop.wire import Leg, Plan
from tests.teleop.conftest import (
    AWAY,
    FROM_SPAWN,
    ID,
    A,
    B,
    C,
    Disk,
    ServiceFlight,
    asked,
    finish,
    service_flying,
)

QUICK = Plan((Leg(A, dwell=0.0),), Start.HERE)
GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


def state(flight, mission_id="m1"):
    return flight.view(mission_id)["state"]


def first_failure(flight, mission_id="m1"):
    return flight.view(mission_id)["verdict"]["failures"][0]["code"]


def reached(flight, mission_id="m1"):
    return [each["waypoint"] for each in flight.view(mission_id)["reached"]]


def go_to(flight, position=AWAY, yaw=0.0):
    flight.teleop.go_to(Leg(position, yaw), flight.now_ns)


# Orders


def test_a_mission_is_flown_and_every_waypoint_noted_once():
    flight, mission_id = service_flying(name="round")
    assert not flight.teleop.over
    finish(flight)
    view = flight.view(mission_id)
    assert (view["id"], view["name"], view["state"]) == ("m1", "round", "done")
    assert flight.names(mission_id) == ["starting", "started", *["reached"] * 3, "done"]
    assert reached(flight) == [0, 1, 2]
    assert [event["id"] for event in view["events"]] == [1, 2, 3, 4, 5, 6]
    assert view["verdict"] == {"outcome": "success", "exit_code": 0, "failures": []}
    assert flight.teleop.over


def test_every_end_of_a_mission_is_counted_under_its_own_name():
    ends = {event for event, state in STATES.items() if state in ENDED}
    assert ends <= set(MISSION_OUTCOMES)


def test_a_key_is_that_of_one_order_for_ever():
    flight, mission_id = service_flying(key="uid")
    finish(flight)
    for _ in range(2):
        assert flight.create(key="uid") == mission_id
        for order in (Order(QUICK, key="uid"), Order(FROM_SPAWN, key="uid", contact=True)):
            with pytest.raises(ConflictError, match="'uid' is that of mission m1, with another"):
                flight.teleop.create(order, flight.now_ns)
        flight.restart_teleop()
    assert flight.create(key="another") == "m2"


def test_a_second_mission_is_refused_or_waits_for_the_first():
    flight, first = service_flying()
    with pytest.raises(ConflictError, match="m1 is flying") as refused:
        flight.create()
    assert refused.value.mission == first
    second, third = flight.create(QUICK, queue=True), flight.create(QUICK, queue=True)
    assert flight.teleop.state(0)["queue"] == [second, third]
    assert state(flight, second) == "queued"
    flight.restart_teleop()
    with pytest.raises(ConflictError):
        flight.create()
    flight.step(seconds=0.05)
    finish(flight)
    flight.step(position=A, seconds=0.2)
    assert [state(flight, mission) for mission in (first, second, third)] == ["done"] * 3
    assert flight.names(second) == ["queued", "starting", "started", "reached", "done"]


def test_the_queue_of_missions_is_bounded():
    flight, _ = service_flying()
    for _ in range(QUEUE_MAX):
        flight.create(queue=True)
    with pytest.raises(ConflictError, match=f"{QUEUE_MAX} missions wait already") as refused:
        flight.create(queue=True)
    assert refused.value.mission == "m1"


def test_between_two_missions_the_robot_is_seen_to_hold():
    """Still on its way, it would be led past the spawn to the second one's first waypoint."""
    flight, first = service_flying()
    second = flight.create(queue=True)
    flight.downlink = False
    finish(flight)
    flight.step(seconds=1.0)
    assert (state(flight, first), state(flight, second)) == ("done", "starting")
    assert flight.requests[-1].request is Request.END
    assert flight.setpoints[-1].waypoint == -1
    flight.downlink = True
    flight.step(seconds=0.12)
    assert flight.requests[-1].request is Request.START
    assert (flight.setpoints[-1], state(flight, second)) == (Setpoint(A, 0.0, 0), "flying")


def test_a_cancelled_mission_is_interrupted_and_the_robot_holds():
    flight, first = service_flying()
    second = flight.create(queue=True)
    flight.teleop.cancel(second, flight.now_ns)
    assert flight.view(second)["verdict"]["exit_code"] == 130
    assert state(flight, first) == "flying"
    flight.teleop.cancel(first, flight.now_ns)
    flight.step(seconds=0.05)
    assert flight.view(first)["verdict"]["outcome"] == "interrupted"
    assert [state(flight, each) for each in (first, second)] == ["cancelled"] * 2
    assert (flight.guard, flight.requests[-1].request) == (HOLD, Request.END)
    with pytest.raises(ConflictError, match="has ended"):
        flight.teleop.cancel(second, flight.now_ns)


def test_the_operator_holds_moves_and_resumes():
    flight = ServiceFlight()
    for verb in (flight.teleop.hold, flight.teleop.resume):
        with pytest.raises(ConflictError, match="no mission"):
            verb(0)
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    assert state(flight) == "held"
    go_to(flight, AWAY, 0.5)
    flight.step()
    assert flight.setpoints[-1] == Setpoint(AWAY, 0.5, -1)
    flight.teleop.resume(flight.now_ns)
    flight.step()
    assert flight.setpoints[-1].position == B
    assert flight.names(mission_id)[-3:] == ["held", "goto", "resumed"]
    with pytest.raises(ConflictError, match="must be held"):
        flight.teleop.resume(flight.now_ns)


def test_go_to_is_a_mission_of_its_own_if_none_is_under_way():
    flight = ServiceFlight()
    flight.step()
    epoch = flight.epoch
    go_to(flight, A)
    flight.step(seconds=0.05)
    with pytest.raises(ConflictError, match="hold or cancel"):
        go_to(flight, B)
    flight.step(position=A, seconds=0.6)
    assert (flight.view("m1")["name"], state(flight), flight.epoch) == ("goto", "done", epoch)


def test_the_setpoint_is_repeated_at_10_hz():
    flight = ServiceFlight()
    flight.step(position=A, seconds=2.0)
    assert len(flight.setpoints) == pytest.approx(20, abs=1)
    assert set(flight.setpoints) == {Setpoint(A)}


@pytest.mark.parametrize(
    ("seen", "codes", "exit_code"),
    [
        ({"pipe_contacts": 2, "touch_speed": 0.1}, ["pipe_touched"], 1),
        ({"touch_speed": 0.3}, ["contact_too_fast"], 1),
        ({}, ["board_not_touched"], 1),
        ({"slip_ns": 1_000_000_000, "touch_speed": 0.1}, ["not_real_time"], 6),
        ({"touch_speed": 0.12}, [], 0),
    ],
)
def test_what_the_robot_touched_decides(seen, codes, exit_code):
    flight, mission_id = service_flying(contact=True)
    vars(flight).update(seen)
    flight.step()
    assert ("board_touched" in flight.names(mission_id)) == ("touch_speed" in seen)
    finish(flight)
    verdict = flight.view(mission_id)["verdict"]
    assert verdict["exit_code"] == exit_code
    assert [failure["code"] for failure in verdict["failures"]] == codes


def test_the_robot_is_told_of_every_waypoint_reached_until_it_knows():
    flight, _ = service_flying()
    number = flight.teleop.book.find("m1").number
    flight.step(seconds=0.05)
    assert flight.onboard == (number, 1)
    flight.downlink = False
    told = len(flight.requests)
    flight.step(position=B, seconds=1.0)
    copies = flight.requests[told:]
    assert {(c.request, c.reached, c.number) for c in copies} == {(Request.PROGRESS, 2, 0)}
    assert 8 <= len(copies) <= 12
    flight.downlink = True
    flight.step(seconds=0.2)
    assert flight.onboard == (number, 2)
    told = len(flight.requests)
    flight.step(seconds=1.0)
    assert len(flight.requests) == told


# Restarts


def test_with_a_full_disk_the_robot_remembers_its_waypoints():
    flight, _ = service_flying(key="uid")
    flight.full = True
    flight.step(position=B, seconds=0.1)
    flight.restart_teleop()  # what was not written is gone
    flight.full = False
    assert reached(flight) == [0]
    flight.step(position=AWAY, seconds=0.1)
    flight.step(position=C, seconds=0.1)
    assert reached(flight) == [0, 1, 2]
    assert "reached, as the robot reports," in str(flight.view("m1")["events"])
    assert flight.view("m1")["verdict"]["exit_code"] == 0


def test_a_cancelled_mission_whose_end_is_lost_is_not_flown_again():
    flight, mission_id = service_flying()
    flight.full = True
    flight.teleop.cancel(mission_id, flight.now_ns)
    flight.step(seconds=0.3)
    flight.full = False
    flight.restart_teleop()
    count = len(flight.requests)
    flight.step(position=AWAY, seconds=1.0)
    assert Request.START not in asked(flight, count)
    assert (flight.guard, first_failure(flight)) == (HOLD, "end_lost")


@pytest.mark.parametrize("guard", [TRACK, GROUND])
def test_after_a_restart_the_mission_continues_at_its_waypoint(guard):
    """Also of a robot that has not taken off yet."""
    flight, mission_id = service_flying(key="uid")
    flight.step(position=AWAY, seconds=5.0)
    flight.slip_ns, flight.guard = 900_000_000, guard  # while teleop is away it does not count
    count = len(flight.requests)
    flight.restart_teleop()
    flight.see()
    flight.step(seconds=0.05)
    assert (state(flight), set(asked(flight, count))) == ("flying", {Request.START})
    assert flight.requests[-1].start is Start.HERE
    assert flight.setpoints[-1].position == B
    assert flight.create(key="uid") == mission_id
    finish(flight)
    assert reached(flight) == [0, 1, 2]
    assert flight.view(mission_id)["verdict"]["exit_code"] == 0
    assert flight.names(mission_id).count("started") == 1


def test_a_cancel_right_after_a_restart_is_a_cancel_in_flight():
    flight, mission_id = service_flying()
    flight.restart_teleop()
    flight.teleop.cancel(mission_id, flight.now_ns)
    flight.step(seconds=0.3)
    assert state(flight) == "cancelled"
    assert "before it began" not in flight.view(mission_id)["events"][-1]["text"]
    assert (flight.onboard[1], flight.guard) == (MISSION_OVER, HOLD)


def test_a_cancel_does_not_hide_a_failure_by_world_restart():
    flight, mission_id = service_flying()
    flight.restart()
    flight.restart_teleop()
    flight.see()
    with pytest.raises(ConflictError, match=f"mission {mission_id} has ended: failed"):
        flight.teleop.cancel(mission_id, flight.now_ns)
    assert first_failure(flight) == "world_restarted"


@pytest.mark.parametrize("is_held", [False, True])
@pytest.mark.parametrize("teleop_too", [False, True])
def test_a_restart_of_cloud_is_told_once_and_asks_nothing_of_the_robot(teleop_too, is_held):
    """Unless teleop is new, too: it knows no other session."""
    flight, mission_id = service_flying()
    if is_held:
        flight.teleop.hold(flight.now_ns)
    before = len(flight.requests)
    flight.restart_cloud()
    if teleop_too:
        flight.restart_teleop()
    flight.step(seconds=1.0)
    assert (state(flight), flight.view(mission_id)["waypoint"]) == (
        "held" if is_held else "flying",
        1,
    )
    assert set(asked(flight, before)) == ({Request.START} if teleop_too else set())
    texts = [e["text"] for e in flight.view("m1")["events"] if e["event"] == "new_session"]
    goes_on = "is held on the way to" if is_held else "goes on to"
    text = "the controller has a new session, as after a restart; the mission"
    assert texts == ([] if teleop_too else [f"{text} {goes_on} waypoint 2 of 3"])


def test_sessions_at_mission_start_or_between_are_not_reported():
    flight, mission_id = service_flying()
    flight.teleop.cancel(mission_id, flight.now_ns)
    flight.step(seconds=0.2)
    flight.restart_cloud()
    flight.step(seconds=0.2)
    second = flight.create()
    flight.step(seconds=0.2)
    assert "started" in flight.names(second)
    assert "new_session" not in flight.names(mission_id) + flight.names(second)


def test_an_unstarted_mission_starts_in_the_new_world():
    flight = ServiceFlight()
    flight.step()
    flight.downlink = False
    flight.create()
    flight.step(seconds=0.2)
    flight.restart()
    flight.restart_teleop()
    flight.downlink = True
    flight.step(seconds=0.05)
    assert state(flight) == "flying"
    assert flight.requests[-1].start is Start.SPAWN


def test_a_held_mission_stays_held_through_restarts():
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    flight.restart_teleop()
    flight.teleop.handle_deadline(flight.now_ns)  # and again, before the robot was seen
    flight.restart_teleop()
    before = len(flight.setpoints)
    flight.step(position=AWAY, seconds=0.1)
    assert state(flight) == "held"
    assert "resumed" not in flight.names(mission_id)
    assert {setpoint.position for setpoint in flight.setpoints[before:]} == {AWAY}
    flight.teleop.resume(flight.now_ns)
    flight.step()
    assert flight.setpoints[-1].position == B


@pytest.mark.parametrize("seen", [True, False])
def test_time_goes_on_where_it_stood(seen):
    flight, mission_id = service_flying()
    flight.step(position=AWAY, seconds=10.0)
    flight.step(position=B)  # noted at 10 s
    flight.uplink = seen
    flight.restart_teleop()
    flight.step(position=AWAY, seconds=0.05)
    elapsed = flight.view(mission_id)["events"][-1]["time_s"]
    assert elapsed == pytest.approx(10.1, abs=0.1)
    flight.step(seconds=50.0)
    assert first_failure(flight) == "timed_out"


def test_a_pipe_touched_while_teleop_was_away_counts():
    flight, _ = service_flying()
    flight.restart_teleop()
    flight.pipe_contacts = 1
    flight.step(seconds=0.05)
    finish(flight)
    assert first_failure(flight) == "pipe_touched"


def test_what_waits_is_not_begun_before_the_robot_is_seen():
    """It may be latched, and would fail it."""
    flight, _ = service_flying()
    waiting = flight.create(queue=True)
    flight.guard = LAND
    flight.step(position=AWAY, seconds=0.2)
    for _ in range(2):
        flight.restart_teleop()
        flight.teleop.handle_deadline(flight.now_ns)
        flight.step(seconds=0.2)
        assert state(flight, waiting) == "queued"


def test_a_restart_with_the_same_options_continues_the_mission():
    flight, flags = ServiceFlight(), Namespace(start=True, mission=None, api=None)
    flight.step()
    for _ in range(2):
        assert _start(flags, load_experiment("hover"), flight.teleop)
        assert list(flight.teleop.book.missions) == ["m1"]
        flight.restart_teleop()
    with pytest.raises(ConflictError, match="mission m1 is"):
        _start(flags, load_experiment("paper"), flight.teleop)
    flight.teleop.cancel("m1", flight.now_ns)
    assert _start(flags, load_experiment("hover"), flight.teleop)
    assert len(flight.teleop.book.missions) == 2


# Stops and landings


@pytest.mark.parametrize("flies", [True, False])
def test_a_stop_fails_the_mission_if_there_is_one(flies):
    flight = service_flying()[0] if flies else ServiceFlight()
    flight.step()
    count = len(flight.requests)
    mission = flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.05)
    assert (flight.guard, set(asked(flight, count))) == (ESTOP, {Request.ESTOP})
    assert flight.teleop.settled
    assert (mission and mission.id) == ("m1" if flies else None)
    if flies:
        assert (state(flight), first_failure(flight)) == ("failed", "emergency_stopped")
        assert "emergency stop on the way to waypoint 2 of 3" in str(flight.view("m1")["events"])


def test_after_a_stall_the_stop_belongs_to_the_stopped_mission():
    """Past teleop's loop: it saw the robot stopped, and that was why the mission had failed."""
    (flight, mission_id), bridge = service_flying(), Bridge()
    bridge.open(flight.teleop)
    urgent = [
        bridge.submit(lambda service, now_ns: service.stop_rotors(now_ns), "stop") for _ in range(2)
    ]
    looked = bridge.submit(lambda service, now_ns: service.state(now_ns)["seen"]["guard"])
    flight.guard = ESTOP
    cloud = SimpleNamespace(receive=lambda: [wire.encode(flight.seen)])
    blind = {"blind": 2, "late_ns": 0, "now_ns": flight.now_ns + 5_000_000_000}
    turn(flight.teleop, cloud, wire.decode, bridge.take, stops=bridge.take_stop, **blind)
    assert {each.result()["id"] for each in urgent} == {mission_id}, "all are one stop"
    assert looked.result() == "ESTOP", "what is no stop is asked of the present"
    flight.step(seconds=0.1)
    assert flight.names(mission_id)[-1] == "emergency_stopped"
    assert flight.teleop.settled


@pytest.mark.parametrize("restarted", [False, True])
def test_no_mission_starts_before_the_stop_is_acknowledged(restarted):
    """Also if teleop died before the robot has heard of the stop: the next one repeats it."""
    flight, mission_id = service_flying()
    queued = flight.create(queue=True)
    flight.downlink = False
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.2)
    if restarted:
        flight.restart_teleop()
    with pytest.raises(ConflictError, match="an emergency stop is on its way to the robot; find"):
        flight.create(queue=True)
    flight.stop.sounds = False  # cloud restarts, too
    flight.downlink = True
    flight.step(seconds=0.3)
    assert flight.guard is ESTOP
    why = r"the guard is in ESTOP \(emergency stop\) and lets nothing fly"
    with pytest.raises(ConflictError, match=why):
        flight.create(queue=True)
    assert state(flight, queued) == "queued"
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.5)
    assert (state(flight, mission_id), state(flight, queued)) == ("failed", "flying")
    with pytest.raises(ConflictError, match="m2 is flying; there is nothing to acknowledge"):
        flight.teleop.acknowledge(flight.now_ns)


def test_an_early_stop_stops_the_current_mission():
    """It stopped nobody's mission: if the robot did not hear, the next teleop flew on."""
    flight, mission_id = service_flying()
    flight.downlink = False
    flight.restart_teleop()
    assert flight.teleop.stop_rotors(flight.now_ns).id == mission_id
    flight.step(seconds=0.2)
    flight.restart_teleop()
    flight.teleop.acknowledge(flight.now_ns)  # before the robot is seen, which flies
    flight.downlink = True
    flight.step(seconds=0.5)
    assert flight.guard is ESTOP
    assert flight.names(mission_id)[-1] == "emergency_stopped"


@pytest.mark.parametrize("since", ["other mission", "other world", "acknowledged", "flown"])
def test_a_stop_is_not_repeated_after_a_later_flight_or_acknowledgement(since):
    flight, _ = service_flying()
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.2)
    if since == "other world":
        flight.restart()
    elif since == "other mission":
        flight.guard, flight.onboard = TRACK, (ID, 1)
    else:
        flight.teleop.acknowledge(flight.now_ns)
        flight.step(seconds=0.2)
    if since == "flown":
        flight.create()
        flight.step(seconds=0.2)
    count = len(flight.requests)
    flight.restart_teleop()
    flight.step(seconds=0.5)
    assert Request.ESTOP not in asked(flight, count)


@pytest.mark.parametrize("since", ["other mission", "other world"])
def test_a_stop_before_first_telemetry_stops_any_flight(since):
    flight, mission_id = service_flying()
    if since == "other world":
        flight.restart()
    flight.guard, flight.onboard = TRACK, (ID, 1)
    flight.restart_teleop()
    assert flight.teleop.stop_rotors(flight.now_ns).id == mission_id
    flight.step(seconds=0.2)
    assert flight.guard is ESTOP


def test_a_stop_after_an_acknowledgement_counts():
    flight, mission_id = service_flying()
    for ask in (flight.teleop.stop_rotors, flight.teleop.acknowledge, flight.teleop.stop_rotors):
        ask(flight.now_ns)
    flight.step(seconds=0.3)
    assert (flight.guard, flight.names(mission_id)[-1]) == (ESTOP, "emergency_stopped")
    for _ in range(SHOWN):
        flight.teleop.book.note(flight.teleop.book.find(mission_id), "new_session", "")
    assert flight.stored().stopped().id == mission_id, "though its event is not kept"


def test_a_landed_robot_flies_again_once_acknowledged():
    flight, _ = service_flying()
    flight.guard = LAND
    flight.step(seconds=0.05)
    assert first_failure(flight) == "guard_stopped"
    for order in (flight.create, lambda: go_to(flight)):
        with pytest.raises(ConflictError, match="the guard is in LAND"):
            order()
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.3)
    second = flight.create()
    flight.step(seconds=0.1)
    assert state(flight, second) == "flying"


@pytest.mark.parametrize("guard", [LAND, ESTOP])
@pytest.mark.parametrize("begun", [0, 1], ids=["starting", "flying"])
def test_a_landing_without_teleop_fails_the_mission(guard, begun):
    flight = ServiceFlight()
    flight.downlink = bool(begun)
    mission_id = flight.create()
    flight.step(seconds=0.1)
    waits = flight.create(queue=True)
    flight.guard = guard
    flight.restart_teleop()
    flight.see()  # before teleop does anything
    flight.step(seconds=0.2)
    assert (first_failure(flight, mission_id), state(flight, waits)) == ("guard_stopped", "queued")


# The end of teleop


def at(moment):
    """A flight with a mission that is idle, starting, flying, held or done."""
    flight = ServiceFlight() if moment in ("idle", "starting") else service_flying()[0]
    flight.step()
    if moment == "starting":
        flight.downlink = False
        flight.create()
        flight.downlink = True
    elif moment == "done":
        finish(flight)
    elif moment == "held":
        flight.teleop.hold(flight.now_ns)
    return flight


@pytest.mark.parametrize(
    ("before", "say"),
    [
        ("idle", ServiceFlight.create),
        ("done", ServiceFlight.create),
        ("held", lambda flight: flight.create(queue=True)),
        *((before, go_to) for before in ("idle", "done", "held")),
        ("held", lambda flight: flight.teleop.resume(flight.now_ns)),
    ],
)
def test_nothing_is_begun_while_teleop_ends(before, say):
    """It is refused, for its sender to say it again to the next teleop; nothing is kept of it."""
    flight = at(before)
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.2)
    kept, count = flight.kept, len(flight.requests)
    with pytest.raises(UnavailableError, match="teleop ends; repeat this when teleop runs again"):
        say(flight)
    flight.step(seconds=0.5)
    assert flight.kept == kept
    assert Request.START not in asked(flight, count)
    assert AWAY not in {setpoint.position for setpoint in flight.setpoints}


def test_what_is_known_stays_known_and_what_waits_waits_for_the_next_teleop():
    flight, first = service_flying(key="uid")
    second = flight.create(queue=True)
    flight.step(position=B, seconds=0.05)
    flight.teleop.pause(flight.now_ns)
    assert flight.create(key="uid") == first
    flight.step(position=C, seconds=0.5)
    assert (state(flight, first), state(flight, second)) == ("done", "queued")
    flight.restart_teleop()
    assert flight.create(key="uid") == first
    flight.step(seconds=0.3)
    assert state(flight, second) == "flying"


@pytest.mark.parametrize("before", ["flying", "restarted", "held", "starting"])
def test_a_shutdown_pauses_the_current_mission(before):
    """The robot stays where it is seen; the next teleop goes on."""
    flight = at(before)
    flight.step(position=(0.5, 0.0, 1.0), seconds=0.0 if before == "starting" else 0.1)
    count = len(flight.requests)
    if before != "flying":
        flight.restart_teleop()
    flight.teleop.pause(flight.now_ns)
    assert flight.kept[-1]["text"].startswith("paused by shutdown on the way to waypoint")
    flight.step(seconds=0.5)
    assert flight.guard in (HOLD, GROUND)
    assert set(asked(flight, count)) == {Request.END}
    if before == "flying":
        assert flight.setpoints[-1].position == (0.5, 0.0, 1.0)
    assert flight.teleop.settled
    flight.restart_teleop()
    flight.step(seconds=0.5)
    assert state(flight) == ("held" if before == "held" else "flying")


def test_during_shutdown_teleop_still_stops_and_releases():
    flight, _ = service_flying()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.1)
    for ask, guard in ((flight.teleop.stop_rotors, ESTOP), (flight.teleop.acknowledge, GROUND)):
        ask(flight.now_ns)
        flight.step(seconds=0.1)
        assert flight.guard is guard


@pytest.mark.parametrize("fsync_ns", [0, 600_000_000, 1_000_000_000])
def test_a_slow_disk_does_not_delay_the_pause_at_shutdown(monkeypatch, fsync_ns):
    """The time for that was over before: the robot flew on to its waypoint."""
    flight, _ = service_flying()
    clock, commit, said = [flight.now_ns], Disk.commit, []

    def sleep(seconds):
        clock[0] += round(seconds * 1e9)

    def fsync(disk):
        clock[0] += fsync_ns
        commit(disk)

    monkeypatch.setattr(Disk, "commit", fsync)
    monkeypatch.setattr("cloudrc.drivers.teleop.time.sleep", sleep)
    monkeypatch.setattr("cloudrc.drivers.teleop.time.monotonic_ns", lambda: clock[0])
    seen = wire.encode(flight.seen)
    cloud = SimpleNamespace(receive=lambda: [seen], send=lambda data: not said.append(data))
    how = {"calls": list, "tell": lambda told: None, "stop": ending(flight.teleop, lambda: True)}
    serve_teleop(flight.teleop, cloud, wire.encode, wire.decode, **how)
    requests = [getattr(wire.decode(each), "request", None) for each in said]
    assert requests.count(Request.END) >= 3
    assert clock[0] - flight.now_ns < 2_000_000_000


# What is shown


def shown(flight):
    return flight.teleop.state(flight.now_ns)["seen"]


@pytest.mark.parametrize(
    ("guard", "mission", "said"),
    [
        (GROUND, None, "waits for a mission; it takes off, after a stop or a landing only when"),
        (GROUND, "flying", "takes off with the mission's first commands, after a stop"),
        (TRACK, None, "is telling the robot that its mission is over"),
        (TRACK, "flying", "flies its mission"),
        (TRACK, "held", "cloudrc mission resume"),
        (HOLD, None, "waits for a mission"),
        (HOLD, "flying", "continues by itself when they arrive"),
        (HOLD, "held", "continues by itself when they arrive"),
        *((stop, how, "find the cause, then: cloudrc mission acknowledge")
          for stop in (LAND, ESTOP) for how in (None, "flying", "held")),
    ],
)  # fmt: skip
def test_what_comes_next_follows_from_the_guard_and_the_mission(guard, mission, said):
    past = SILENCE + 0.01
    assert said in next_step(guard, 0.01, 0.01, mission)
    assert said in next_step(guard, SILENCE, SILENCE, mission)
    assert next_step(guard, past, SILENCE, mission) == NOT_HEARD
    assert next_step(guard, past, past, mission) == NO_CLOUD


def test_the_state_is_shown_with_cause_and_since_when_in_this_world():
    flight, _ = service_flying()
    flight.step(seconds=0.5)
    assert shown(flight)["guard_for_s"] > 0.5
    assert shown(flight)["next_step"] == "the robot flies its mission"
    flight.guard, flight.cause, flight.downlink = HOLD, Cause.SILENCE, False
    flight.step()
    assert (shown(flight)["guard"], shown(flight)["guard_for_s"]) == ("HOLD", 0.0)
    flight.step(seconds=0.5)
    flight.uplink = False
    flight.step(seconds=2.0)
    assert (shown(flight)["guard_for_s"], shown(flight)["cause"]) == (None, "no fresh commands")
    assert shown(flight)["age_s"] == pytest.approx(2.0)
    flight.uplink = True
    flight.restart_cloud()
    flight.step()
    assert shown(flight)["guard_for_s"] == pytest.approx(2.51)
    flight.restart()
    flight.guard = HOLD
    flight.step()
    assert shown(flight)["guard_for_s"] == 0.0


def test_a_silent_robot_is_told_from_a_silent_cloud():
    flight = ServiceFlight()
    assert flight.teleop.state(0)["cloud_age_s"] is None
    flight.teleop.hear(1_000_000_000)  # before the robot is seen
    assert flight.teleop.state(3_000_000_000) == {
        **{"mission": None, "queue": [], "cloud_age_s": 2.0, "seen": None},
    }
    for cloud in (True, False):
        flight.step()
        for _ in range(10):
            flight.now_ns += 200_000_000
            if cloud:
                flight.teleop.hear(flight.now_ns)
        age = flight.teleop.state(flight.now_ns + 50_000_000)["cloud_age_s"]
        assert age == pytest.approx(0.05 if cloud else 2.05)
        assert shown(flight)["next_step"] == (NOT_HEARD if cloud else NO_CLOUD)
