"""Safety invariants, checked after every 2 ms step, independently of the guard.

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

All limits come from configuration, robot and docs/, not from the guard: from "Stop rule" and
"Leaving HOLD" in reference/plant.md, F5 and F23 in reference/faults.md, and "The guard" in
safety.md. `motion_checks` looks at fence, cap, stop and rest, `contact_checks` at collision and at
what is switched off, `order_checks` at stale, latch and hold.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from typing import NamedTuple

from cloudrc.faults.contact_checks import ContactChecks
from cloudrc.faults.facts import FLOWN, Facts
from cloudrc.faults.motion_checks import MotionChecks
from cloudrc.faults.order_checks import OrderChecks
from cloudrc.messages import Command, GuardState, OperatorRequest, Request, Start
from cloudrc.records import CommandApplied, Record, SessionOpened
from cloudrc.sim.onboard import Commands
from cloudrc.sim.readings import Readings
from cloudrc.world.robot import STEP_NS, Robot

TRACK = GuardState.TRACK  # looking up a member of an enum is slow
REPORTED = 5  # number of breaches of each kind that are kept


class Breach(NamedTuple):
    """A violation of an invariant: the invariant's name, and what happened."""

    time: float  # time on world's clock [s]
    kind: str
    text: str


class Watch:
    """Collects the breaches of invariants in a flight, and checks the order of commands."""

    def __init__(self, facts: Facts) -> None:
        self.facts = facts
        self.breaches: list[Breach] = []  # the first ones of each kind
        self.counts: Counter[str] = Counter()  # of breaches, by kind
        self.margin = 9.0  # smallest distance of the base to the fence, without the floor [m]
        self.speed = 0.0  # largest reference [m/s]
        self.starts_ns: list[int] = []  # when world's processes began [ns]
        self._newest = (0, 0, -1)  # newest command: process of world, epoch and counter

    def attach(self, robot: Robot, start_ns: int, *, honest: bool) -> None:
        """Check a robot from `start_ns` [ns] on; check its contacts only if cloud is `honest`."""
        robot.observers.append(RobotInvariants(robot, self, start_ns, honest))
        self.starts_ns.append(start_ns)

    def see(self, records: list[Record], now_ns: int) -> None:
        """Check in the new `records` of world that each command was applied once and in order.

        The order of commands is that of epochs and, within an epoch, of counters. It begins anew
        with each process of world: if cloud knows no epoch, a restarted world begins at the first.
        """
        for record in records:
            if isinstance(record, CommandApplied | SessionOpened):
                counter = record.counter if isinstance(record, CommandApplied) else -1
                process = bisect_right(self.starts_ns, record.stamp_ns)
                if (this := (process, record.epoch, counter)) <= self._newest:
                    text = f"command {counter} of epoch {record.epoch} after {self._newest[1:]}"
                    self.note(record.stamp_ns, "order", text)
                self._newest = max(self._newest, this)

    def note(self, now_ns: int, kind: str, text: str) -> None:
        """Record a breach of the invariant `kind` at `now_ns` [ns]; `text` describes it."""
        self.counts[kind] += 1
        if self.counts[kind] <= REPORTED:
            self.breaches.append(Breach(now_ns * 1e-9, kind, text))


class RobotInvariants:
    """Checks one robot after every step of its physics; an `Observer`."""

    def __init__(self, robot: Robot, watch: Watch, start_ns: int, honest: bool) -> None:
        self._guard, self._simulator, self._note = robot.guard, robot.simulator, watch.note
        self._stopped = robot.onboard.stopped
        self._was = self._state = robot.guard.state  # after the last step; after the last event
        self._next_ns, self._steps = start_ns, 0
        self._orders, self._motion = OrderChecks(watch), MotionChecks(watch)
        self._contacts = ContactChecks(watch, robot.simulator, honest=honest)

    def see_step(self, now_ns: int, readings: Readings, commands: Commands) -> None:
        """Implement `Observer.see_step`: check all invariants."""
        steps, was, state = self._simulator.steps, self._was, self._guard.state
        motion, contacts, orders = self._motion, self._contacts, self._orders
        if now_ns != self._next_ns or steps != self._steps + 1:
            self._note(now_ns, "tick", "a step of the physics without a tick of the guard")
        self._next_ns, self._steps = now_ns + STEP_NS, steps
        if state is not was:
            orders.check_change(was, state, now_ns)
            contacts.check_hit(state, now_ns)
        orders.check_wait(state, now_ns)
        # Hard braking may command actuators of a robot to 0, too: only the object itself counts.
        is_on = commands is not self._stopped
        contacts.check_actuators(state, readings.velocity, is_on, now_ns)
        motion.check_fence(was, state, readings, now_ns)
        if was is TRACK and state is not TRACK:
            motion.leave_track(readings, now_ns)
        if state in FLOWN:
            self._check_flown(state, readings, is_on, now_ns)
        elif is_on:
            self._note(now_ns, "latch", f"actuators on in {state.name}")
        if contacts.check_touches(state, now_ns):
            motion.touch(now_ns)
        motion.before = self._guard.reference
        self._was = self._state = state

    def _check_flown(self, state: GuardState, readings: Readings, is_on: bool, now_ns: int) -> None:
        """Check a step in TRACK, HOLD or LAND."""
        motion, orders, at = self._motion, self._orders, readings.position
        self._contacts.comes_down = state is GuardState.LAND
        motion.check_reference(self._guard, at, orders.ramped(now_ns), now_ns)
        if state is TRACK:
            orders.check_track(now_ns)
        elif is_on:
            motion.check_rest(at, now_ns)

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """Implement `Observer.see_command`: check an accepted command's age, count invalid ones."""
        self._orders.see_command(command, rejection, self._state, now_ns)
        self._state = self._guard.state

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """Implement `Observer.see_request`: store what the request allows the robot to do."""
        if request.request is Request.START and request.start is Start.SPAWN:
            self._steps, self._contacts.is_asked = 0, True
        elif request.request is Request.ESTOP:
            self._contacts.is_asked = True
            if self._state in FLOWN:
                self._motion.falls = self._contacts.comes_down = True
        self._orders.see_request(request, self._state, now_ns)
        self._state = self._guard.state

    def see_session(self, now_ns: int) -> None:
        """Implement `Observer.see_session`: forget the commands of the old session."""
        self._orders.forget_commands()
