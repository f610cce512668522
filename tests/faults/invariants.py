# SPDX-License-Identifier: Apache-2.0

"""Safety invariants, checked in every 2 ms step of a flight, independently of the guard.

fence      The robot's base stays inside the fence while its actuators are on. After a collision or
           an emergency stop the robot may leave the fence by at most `FALL_MAX`. A robot that is
           switched off starts again only if it is at rest inside the fence. On the ground only the
           walls count.
cap, stop  The velocity reference stays within its limits, and the robot can always stop before the
           fence. During LAND the robot may fly down to the floor. After a HOLD the reference
           velocity grows slowly at first. That of a planar robot is horizontal.
stale      World rejects a command that is based on too old odometry. TRACK ends with the session,
           or when the last command's odometry is too old and the command's plan has ended. HOLD
           changes to TRACK only after `RESUME_COMMANDS` fresh commands within `RESUME_NS`.
rest       After TRACK the robot stops within its stopping distance. It is switched off only on a
           request, after a collision, or if it does not move.
collision  If the cloud is honest, only the robot's probe touches something, and it touches only the
           body that the mission names. A robot that lands, or that the operator has stopped, may
           touch anything, because the guard does not know what is below the robot.
latch      The robot is in TRACK only during a mission that the operator has started. LAND and ESTOP
           last until the operator acknowledges them.
hold       At least `SETTLE_NS` pass between two changes to TRACK. In a mission, a robot without
           commands lands after the configured time, or sooner after impossible commands.
order      Each applied command is newer than the last one, and not of an old session.
tick       The guard runs once in each step of the physics.

All limits come from configuration, robot and docs/, not from the guard: from "The guard" in
safety.md, and F5 and F23 of faults.md. `observer` checks, during the flight, commands
that world accepts and changes of the guard's state (stale, latch and hold). This module checks all
else in the rows that it has kept.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.text import describe_point
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import CommandApplied, Record, SessionOpened
from cloudrc.world.robot import STEP, STEP_NS
from tests.faults.observer import LONG_NS, ROW, RobotObserver
from tests.faults.rules import ESTOP, FLOWN, HOLD, LAND, TRACK, Breach, Rules

SLACK = 1e-9  # tolerance for rounding [m/s]
STILL = 0.12
"""Largest speed of a robot at rest [m/s]: the guard's limit, 0.1, plus one step of free fall."""
REST = 0.5
"""Tolerance of the stopping distance after TRACK [m]; it includes a swing of up to 0.2 m."""
REACTION = 0.2  # time until the robot brakes as hard as it can [s]
MARGIN = 0.1  # distance from a face of the fence at which the robot has to stop [m]
FALL_MAX = 1.5  # largest distance that a falling robot may leave the fence [m]
THROWN_NS = 3_000_000_000  # time after a collision in which the robot may leave the fence [ns]
REELS_NS = 1_000_000_000  # time after a collision in which it explains the robot's motion [ns]
STANDS = 0.2  # speed per axis up to which a robot stands when it is switched off [m/s]
FALL = 1.0
"""Downward speed that proves a fall while switched off [m/s]; a drop of 2 cm ends at only 0.7."""
BRAKE_NS = 200_000_000  # time to stop a descent that the operator has acknowledged [ns]
FLOOR = "floor"  # body on which a robot may always stand
SHOWN = "position", "velocity", "reference"  # columns that the text of a breach shows

Array: TypeAlias = NDArray[Any]
Broken: TypeAlias = Iterator[tuple[str, Array, str]]
"""Name of an invariant, in which steps it is broken, and what happens in them."""


class FlightSteps:
    """The steps of a robot as arrays with one entry per step.

    Attributes:
        rows: The rows of the robot's observer.
        flown: Whether the guard is in a state in which the robot flies.
        was: State of the guard in the step before.
        before: The reference in the step before [m/s].
        touches: The contacts, without those of wheels with the floor; each with its step.
        touched_ns: Time since the last contact began [ns].
        margin: Distance of the base to the nearest wall or the ceiling [m]; below 0 outside.
        falls: Whether the robot was stopped or hit in the air, and has not flown since.
        thrown: Whether the robot is outside the fence, or has just been, because of a contact.
    """

    def __init__(self, observer: RobotObserver) -> None:
        self._observer, self.rules, rules = observer, observer.rules, observer.rules
        rows = self.rows = np.array(observer.rows, ROW).view(np.recarray)
        self.was, self.before = _before(rows.state), _before(rows.reference)
        self.flown = np.isin(rows.state, FLOWN)
        rolls_on = FLOOR if rules.planar else ""
        self.touches = [each for each in observer.touches if each[1].body != rolls_on]
        touched = np.isin(np.arange(len(rows)), [step for step, _ in self.touches])
        self.touched_ns = self.since(touched)
        below, above = rows.position - rules.low, rules.high - rows.position
        self.margin = np.hstack((below[:, :2], above)).min(axis=1)
        hit = _before(self.flown) & (rows.state == ESTOP)
        self.falls = self.since(hit | rows.downed) < self.since(self.flown)
        back = (self.margin >= 0.0) & (self.touched_ns >= THROWN_NS)
        self.thrown = self.touched_ns < self.since(back)

    def since(self, event: Array) -> Array:
        """Return the time [ns] since the last step in which `event` was true, this one included."""
        now_ns: Array = self.rows.now_ns
        return now_ns - np.maximum.accumulate(np.where(event, now_ns, -LONG_NS))

    @property
    def smallest_margin(self) -> float:
        """Smallest distance of the base to walls and ceiling [m], unless it falls; 9 at most."""
        counts = ~self.falls & ((self.margin >= 0.0) | ~self.thrown)
        return float(self.margin[counts].min(initial=9.0))

    @property
    def top_speed(self) -> float:
        """Largest reference [m/s]."""
        return float(np.fmax.reduce(_norm(self.rows.reference[self.flown]), initial=0.0))

    def breaches(self) -> Iterator[Breach]:
        """Yield each breach of an invariant, in the step in which it begins."""
        yield from self._observer.breaches
        for check in (_steps, _fence, _reference, _rest, _contacts):
            for kind, broken, what in check(self):
                for row in self.rows[broken & ~_before(broken)]:
                    motion = [f"{name} {describe_point(row[name])}" for name in SHOWN]
                    text = f"{what} in {GuardState(row.state).name}, {', '.join(motion)}"
                    yield Breach(row.now_ns * 1e-9, kind, text)


def _before(values: Array) -> Array:
    """Return the values in the step before; 0 in the first step."""
    shifted = np.roll(values, 1, axis=0)
    shifted[:1] = 0
    return shifted


def _norm(vectors: Array) -> Array:
    norms: Array = np.sqrt((vectors * vectors).sum(axis=1))
    return norms


def _steps(steps: FlightSteps) -> Broken:
    rows, now_ns = steps.rows, steps.rows.now_ns
    skips = (np.diff(rows.steps, prepend=0) != 1) & (rows.steps != 1)
    late = np.diff(now_ns, prepend=now_ns[:1] - STEP_NS) != STEP_NS
    yield "tick", skips | late, "a step of the physics without a tick of the guard"
    tracks = rows.state == TRACK
    yield "latch", tracks & ~rows.armed, "without the operator's start"
    yield "stale", tracks & (now_ns > rows.fresh_until_ns), "without a fresh command"
    yield "hold", rows.armed & (now_ns > rows.waits_until_ns + STEP_NS), "alone for too long"


def _fence(steps: FlightSteps) -> Broken:
    rows, floor = steps.rows, steps.rules.low[2]
    low = rows.position[:, 2] < floor
    yield "fence", low, "below the floor"
    may_leave = steps.falls | steps.thrown
    out = steps.margin < np.where(may_leave, -FALL_MAX, 0.0)
    yield "fence", out, "outside"
    starts = steps.flown & (_before(steps.falls) | rows.downed)
    rests = (_norm(rows.velocity) <= STILL) & (steps.margin >= 0.0) & ~low
    yield "fence", starts & ~rests, "took off after a stop, not at rest inside the fence"


def _stop_distance(speed: Array, rules: Rules) -> Array:
    """Return the way from `speed` [m/s] to rest [m].

    Source: docs/safety.md, "Stop rule".
    """
    distance: Array = speed * (REACTION + speed / (2.0 * rules.braking))
    return distance


def _reference(steps: FlightSteps) -> Broken:
    rows, rules, v = steps.rows, steps.rules, steps.rows.reference
    room = np.where(v > 0.0, rules.high - rows.position, rows.position - rules.low)
    stops = (v == 0.0) | (_stop_distance(abs(v), rules) <= room - MARGIN + SLACK)
    stops[:, 2] |= (rows.state == LAND) & (v[:, 2] < 0.0)
    yield "stop", steps.flown & ~stops.all(axis=1), "too fast to stop before the fence"
    # The negated comparisons find NaN, too.
    turns = ~(abs(rows.yaw_rate) <= rules.limits.yaw_rate_max_radps)
    yield "cap", steps.flown & turns, "the reference turns too fast"
    fast = ~(_norm(v) <= rules.limits.speed_max_mps + SLACK)
    yield "cap", steps.flown & fast, "the reference is too fast"
    yield "cap", steps.flown & rules.planar & (v[:, 2] != 0.0), "the reference leaves the ground"
    most = np.where(rows.ramped, rules.braking, rules.limits.acceleration_max_mps2)
    grows = ~(_norm(growth(steps.before, v)) <= most * STEP + SLACK)
    # Braking is not limited: at the fence, or after a collision.
    yield "cap", (rows.state == TRACK) & grows, "the reference grows too fast"


def growth(before: Array, after: Array) -> Array:
    """Return how much velocities grow per axis from `before` to `after` [m/s], shape (n, 3).

    It is 0 if the speed falls. If the direction reverses, all of the new speed is growth.
    """
    grown = np.maximum(abs(after) - abs(before), 0.0)
    turned: Array = np.where(before * after < 0.0, abs(after), grown)
    return turned


def _rest(steps: FlightSteps) -> Broken:
    rows, rules = steps.rows, steps.rules
    yield "latch", rows.is_on & ~steps.flown, "actuators on"
    left = (steps.was == TRACK) & (rows.state != TRACK)
    left_ns = steps.since(left)
    last = np.maximum.accumulate(np.where(left, np.arange(len(rows)), 0))
    speed = np.fmax(_norm(rows.velocity), _norm(steps.before))[last]
    way = _norm((rows.position - rows.position[last])[:, :2])
    far = (way > _stop_distance(speed, rules) + REST) & (steps.touched_ns >= left_ns + REELS_NS)
    waits = steps.flown & (rows.state != TRACK) & rows.is_on & (left_ns < LONG_NS)
    yield "rest", waits & far, "far from where the last command ended"
    excused = rows.asked | (rows.touch_age <= REELS_NS * 1e-9)
    goes_off = _before(rows.is_on) & ~rows.is_on
    alone = goes_off & ~rows.asked & (rows.state != ESTOP)
    moves = ~(abs(rows.velocity) <= STANDS).all(axis=1)
    yield "rest", alone & moves, "switched off in motion"
    halted = steps.since(alone) < steps.since(rows.is_on | rows.asked | (goes_off & ~alone))
    falls = halted & ~alone & ~excused & (rows.velocity[:, 2] < -FALL)
    yield "rest", falls, "falls, switched off in the air"


def _contacts(steps: FlightSteps) -> Broken:
    rows, rules = steps.rows, steps.rules
    hit = (steps.was != ESTOP) & (rows.state == ESTOP) & ~rows.asked
    yield "collision", hit & (rows.touch_age > REELS_NS * 1e-9), "stopped although nothing touches"
    lands = rows.state == LAND
    # A landing that is acknowledged just above an obstacle cannot stop in time.
    lands |= (rows.state == HOLD) & (steps.since(lands) <= BRAKE_NS)
    in_air = steps.flown & (rows.state != LAND)
    comes_down = steps.since(rows.downed | (rows.state == LAND)) < steps.since(in_air)
    for step, touch in steps.touches:
        is_named = touch.by_probe and touch.body == rules.touched
        lies = not steps.flown[step] and (comes_down[step] or touch.body == FLOOR)
        if not (is_named or lands[step] or lies):
            yield "collision", np.arange(len(rows)) == step, f"touched {touch.body}"


def check_order(records: Iterable[Record], starts_ns: Sequence[int]) -> Iterator[Breach]:
    """Check in world's records that each command was applied once and in order.

    The order of commands is that of epochs and, within an epoch, of counters. It begins anew with
    each process of world, from `starts_ns` [ns] on: if cloud knows no epoch, a restarted world
    begins at the first.
    """
    newest = (0, 0, -1)  # process of world, epoch and counter
    for record in records:
        if isinstance(record, CommandApplied | SessionOpened):
            counter = record.counter if isinstance(record, CommandApplied) else -1
            process = bisect_right(starts_ns, record.stamp_ns)
            if (this := (process, record.epoch, counter)) <= newest:
                text = f"command {counter} of epoch {record.epoch} after {newest[1:]}"
                yield Breach(record.stamp_ns * 1e-9, "order", text)
            newest = max(newest, this)
