# SPDX-License-Identifier: Apache-2.0

"""Driving by hand: the moving setpoint, its limits and its end, and what an operator may do."""

import os
import pty
import select
import subprocess
import sys
import threading
import time
from contextlib import suppress
from math import dist, hypot

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.teleop.carrot import ACCELERATION, setpoint_at, steer
from cloudrc.teleop.refusals import ConflictError
from cloudrc.teleop.wire import decode, encode
from cloudrc.wire.messages import ZERO, GuardState, Setpoint
from tests.fences import FENCE
from tests.teleop.conftest import (
    AWAY,
    PERIOD_NS,
    A,
    ServiceFlight,
    reference,
    running,
    service_flying,
)

COMMAND = [sys.executable, "-m", "cloudrc", "mission", "drive", "--api"]
EAST = (0.5, 0.0, 0.0)
SPEEDS = st.tuples(*[st.floats(-1.5, 1.5)] * 3)
STEPS = st.lists(st.tuples(SPEEDS, st.integers(1, 60)), max_size=12)


def inside(setpoint, axis):
    return FENCE.inner_low[axis] < setpoint.position[axis] < FENCE.inner_high[axis]


@settings(max_examples=30, deadline=None)
@given(STEPS, st.tuples(*map(st.floats, FENCE.inner_low, FENCE.inner_high)))
def test_the_setpoint_keeps_its_limits_and_rests(steps, start):
    """At the fence itself an axis may stop at once: the others can use up the acceleration."""
    setpoint, now_ns = Setpoint(start), 0
    for velocity, periods in [*steps, (ZERO, 300)]:
        setpoint = steer(setpoint, velocity, now_ns, FENCE)
        for _ in range(periods):
            before, now_ns = setpoint_at(setpoint, now_ns), now_ns + PERIOD_NS
            after = setpoint_at(setpoint, now_ns)
            sides = zip(FENCE.inner_low, after.position, FENCE.inner_high, strict=True)
            assert all(low <= at <= high for low, at, high in sides)
            free = [i for i in range(3) if inside(before, i) and inside(after, i)]
            change = hypot(*(after.velocity[i] - before.velocity[i] for i in free))
            assert change <= ACCELERATION * 0.01 + 1e-9
    assert (after.velocity, after.position) == (ZERO, setpoint.position)
    assert decode(encode(setpoint)) == setpoint


def press(flight, velocity=EAST, seconds=1.0):
    """Hold a key: a request ten times a second, by the service's clock."""
    for _ in range(round(10 * seconds)):
        flight.teleop.drive(velocity, flight.now_ns)
        flight.step(seconds=0.1)


def step_after(flight):
    return flight.teleop.state(flight.now_ns)["seen"]["next_step"]


def names(flight):
    return [event.event for event in flight.events]


@pytest.fixture
def driven():
    """A robot that was driven off the ground, by a key that is still held."""
    flight = ServiceFlight()
    flight.step()
    press(flight)
    return flight


def test_the_first_request_takes_off_from_here(driven):
    assert (driven.newest.state, driven.newest.order.name) == ("held", "drive")
    assert names(driven) == ["started", "held", "driving"]
    at = reference(driven)
    assert at.position == pytest.approx((0.38, 0.0, 0.35), abs=0.06)
    assert at.velocity == EAST
    press(driven, (9.0, 0.0, 0.0))
    assert reference(driven).velocity == pytest.approx((1.5, 0.0, 0.0))


@pytest.mark.parametrize(("limit", "fastest"), [(0.8, 0.8), (6.0, 1.5)])
def test_a_drive_is_not_faster_than_the_guard_allows(limit, fastest):
    flight = ServiceFlight(speed_max=limit)
    flight.step()
    press(flight)
    press(flight, (9.0, 0.0, 0.0))
    assert reference(flight).velocity == pytest.approx((fastest, 0.0, 0.0))


def test_without_requests_the_setpoint_brakes_and_rests(driven):
    last_ns = driven.now_ns - 10 * PERIOD_NS
    driven.step(seconds=0.4)
    assert reference(driven).velocity == EAST
    driven.step(seconds=0.1)
    assert dist(ZERO, reference(driven).velocity) < 0.5
    assert names(driven)[-1] == "operator_lost"
    assert driven.events[-1].stamp_ns - last_ns <= 520_000_000
    driven.step(seconds=1.0)
    assert reference(driven).velocity == ZERO
    assert "the operator holds" in step_after(driven)
    press(driven)  # the operator is back
    assert reference(driven).velocity == EAST
    assert "the operator drives" in step_after(driven)
    driven.teleop.hold(driven.now_ns)
    with pytest.raises(ConflictError, match="let go"):
        press(driven)
    assert "the operator holds" in step_after(driven)


def test_a_key_that_is_released_is_no_lost_operator(driven):
    press(driven, ZERO, 0.1)
    driven.step(seconds=2.0)
    assert reference(driven).velocity == ZERO
    assert "operator_lost" not in names(driven)


def test_after_an_interrupted_drive_the_operator_must_let_go(driven):
    def ended(verb, *words):
        press(driven, seconds=0.1)
        getattr(driven.teleop, verb)(*words, driven.now_ns)
        driven.step(seconds=0.1)
        with pytest.raises(ConflictError, match="let go"):
            press(driven)
        assert reference(driven).velocity == ZERO

    ended("hold")
    with pytest.raises(ConflictError, match="must be flying"):
        driven.teleop.hold(driven.now_ns)
    press(driven, ZERO, 0.1)  # lets go
    ended("cancel", "m1")
    driven.step(seconds=0.6)  # lets go, too
    press(driven)
    driven.teleop.switch_off(driven.now_ns)
    driven.step(seconds=0.3)
    with pytest.raises(ConflictError, match="acknowledge"):
        press(driven)
    driven.teleop.acknowledge(driven.now_ns)
    driven.step(seconds=0.1)
    with pytest.raises(ConflictError, match="let go"):
        press(driven)
    missions = driven.teleop.book.missions.values()
    assert [mission.state for mission in missions] == ["cancelled", "failed"]


def test_only_a_held_mission_is_driven():
    flight = ServiceFlight()
    with pytest.raises(ConflictError, match="once telemetry has arrived"):
        press(flight)
    flight.step()
    with pytest.raises(ConflictError, match="other than zero makes the robot start"):
        press(flight, ZERO)
    flight, mission_id = service_flying()
    with pytest.raises(ConflictError, match=f"{mission_id} is flying; hold or cancel it first"):
        press(flight)
    flight.teleop.hold(flight.now_ns)
    press(flight, ZERO, 0.1)
    press(flight)
    press(flight, ZERO, 0.1)
    press(flight)
    assert reference(flight).position[0] > A[0]
    flight.teleop.resume(flight.now_ns)
    flight.step()
    assert flight.setpoints[-1].waypoint == 1
    assert flight.view(mission_id)["state"] == "flying"


@pytest.mark.parametrize("trouble", ["guard", "cloud", "teleop", "silence"])
def test_the_setpoint_waits_at_the_robot_in_trouble(driven, trouble):
    if trouble == "guard":
        driven.guard = GuardState.HOLD
    elif trouble == "cloud":
        driven.restart_cloud()
    elif trouble == "teleop":
        driven.restart_teleop()
    driven.uplink = trouble != "silence"
    driven.position = AWAY
    driven.step(seconds=0.1)
    press(driven, seconds=1.0)
    driven.step(seconds=1.0)
    at = reference(driven)
    assert at.velocity == ZERO
    if trouble != "teleop":  # a new teleop goes on at once
        assert dist(at.position, (0.8, 0.0, 0.35) if trouble == "silence" else AWAY) < 0.5


# Over HTTP and in a terminal


class Terminal:
    """`cloudrc mission drive` in a terminal, which shows the state of the robot already."""

    def __init__(self, api):
        self.screen, (self._keys, end) = "", pty.openpty()
        environ = {**os.environ, "TERM": "xterm", "LINES": "24", "COLUMNS": "90"}
        how = {**dict.fromkeys(("stdin", "stdout", "stderr"), end), "env": environ}
        self.process = subprocess.Popen([*COMMAND, api.url], start_new_session=True, **how)
        os.close(end)
        self._reads = threading.Thread(target=self._read, daemon=True)
        self._closes = False
        self._reads.start()
        while "GROUND" not in self.screen:  # a busy machine starts it slowly
            assert self.process.poll() is None, self.screen
            time.sleep(0.1)

    def _read(self):
        with suppress(OSError):  # the process has ended
            while not self._closes:
                if select.select([self._keys], [], [], 0.1)[0]:
                    self.screen += os.read(self._keys, 4096).decode(errors="replace")

    def type(self, keys):
        os.write(self._keys, keys.encode())

    def close(self):
        self._closes = True
        self._reads.join()
        os.close(self._keys)


@pytest.mark.process
def test_keys_in_a_terminal_drive_the_robot():
    with running(unix=True) as api:
        flight, terminal = api.flight, Terminal(api)
        for key, axis, sign in (("\x1bOA", 0, 1), ("\x1bOC", 1, -1), ("w", 2, 1)):
            terminal.type(key)
            api.until(lambda a=axis, s=sign: s * reference(flight).velocity[a] > 0.1)
            terminal.type(" ")
            api.until(lambda: reference(flight).velocity == ZERO)
        terminal.type("w")  # and no repetition
        api.until(lambda: reference(flight).velocity[2] > 0.1)
        api.until(lambda: reference(flight).velocity == ZERO)
        terminal.type("hh")
        api.until(lambda: "must be flying" in terminal.screen)
        terminal.type("X" * 20)
        api.until(lambda: "pasted text" in terminal.screen)
        assert flight.guard is not GuardState.ESTOP
        terminal.type("X")
        api.until(lambda: flight.guard is GuardState.ESTOP)
        terminal.type("q")
        assert terminal.process.wait(10.0) == 0
