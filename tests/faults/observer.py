# SPDX-License-Identifier: Apache-2.0

"""Observe a robot: keep each step of its physics; check the invariants stale, latch and hold."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from cloudrc.physics.sim.onboard import Commands
from cloudrc.physics.sim.readings import Readings
from cloudrc.wire.messages import PLAN_STEP_NS, Command, GuardState, OperatorRequest, Request, Start
from cloudrc.wire.records import Contact
from cloudrc.world.robot import Observer, Robot
from tests.faults.rules import ESTOP, FLOWN, GROUND, HOLD, LAND, LATCHED, TRACK, Breach, Rules

RESUME_COMMANDS, RESUME_NS = 10, 500_000_000
"""Number of fresh commands that end a HOLD, and the time within which they must arrive [ns]."""
SETTLE_NS = 1_000_000_000  # shortest time between two changes to TRACK [ns]
INVALID_COMMANDS, INVALID_NS = 5, 1_000_000_000
"""Number of impossible commands that cause a landing, if they arrive within INVALID_NS [ns]."""
INVALID = ("range", "vertical", "future")  # why the guard rejects impossible commands
GROUND_NS = 10_000_000_000
"""Shortest time that a robot on the ground waits for a mission's first command [ns]."""
LONG_NS = 1 << 60
"""Longer than any flight [ns]."""
RAMP_MIN = 1.0
"""Shortest time of slow growth of the velocity reference after a HOLD [s]."""
ROW = np.dtype([
    ("now_ns", "i8"),  # beginning of the step [ns], world's clock
    ("steps", "i8"),  # number of steps of the physics since the robot was put at its spawn
    ("state", "i1"),
    ("position", "f8", 3),  # of the base [m], world frame
    ("velocity", "f8", 3),  # of the base [m/s], world frame
    ("reference", "f8", 3),  # velocity that the robot follows [m/s], world frame
    ("yaw_rate", "f8"),  # that the robot follows [rad/s]
    ("is_on", "?"),  # whether the actuators are on
    ("touch_age", "f8"),  # time since the last contact [s]
    ("ramped", "?"),  # whether the reference must grow slowly, because a HOLD has just ended
    ("armed", "?"),  # whether a mission is on
    ("fresh_until_ns", "i8"),  # when the newest command or its plan gets too old [ns]
    ("waits_until_ns", "i8"),  # how long the robot may wait for commands in this state [ns]
    ("asked", "?"),  # whether the operator has stopped or reset the robot since the last step
    ("downed", "?"),  # whether the operator has stopped it in the air since the last step
])  # fmt: skip
"""What is kept of each step."""


class RobotObserver:
    """Observes one robot from the start of its world process on; times are on world's clock [ns].

    It checks each change of the guard's state, from the commands and requests that came before.

    Attributes:
        rows: What happened in each step, with the columns of `ROW`.
        touches: The contacts that began, each with the number of its row.
        breaches: Breaches of the invariants stale, latch and hold.
    """

    def __init__(self, robot: Robot, rules: Rules, start_ns: int) -> None:
        """Observe a robot whose first step begins at `start_ns` [ns]."""
        self.rules, self.start_ns, limits = rules, start_ns, rules.limits
        self.rows, self.touches = list[tuple[Any, ...]](), list[tuple[int, Contact]]()
        self.breaches = list[Breach]()
        self._robot = robot
        self._list, self._seen = robot.simulator.touches, 0  # how many of the list were seen
        self._was = self._state = robot.guard.state  # after the last step; after the last event
        self._asked = self._downed = False
        self._age_ns = round(limits.command_age_max_ms * 1e6)
        self._plan_ns = round(limits.plan_max_s * 1e9)
        self._ramp_ns = round(max(RAMP_MIN, limits.speed_max_mps / rules.braking) * 1e9)
        hold_ns = round(limits.hold_max_s * 1e9)
        self._waits_ns = {HOLD: hold_ns, GROUND: max(hold_ns, GROUND_NS)}
        self._fresh_until_ns = -1  # when the last accepted command gets too old
        self._ramp_until_ns, self._alone_ns, self._tracked_ns = -1, 0, -SETTLE_NS
        self._armed = False  # whether a mission is on
        self._released = set[GuardState]()  # states acknowledged since the last change
        self._is_reset = self._impossible = False
        self._fresh_ns = deque[int](maxlen=RESUME_COMMANDS)
        self._invalid_ns = deque[int](maxlen=INVALID_COMMANDS)
        tells = self.see_step, self.see_command, self.see_request, self.see_session
        robot.observers.append(Observer(*tells))

    def see_step(self, now_ns: int, readings: Readings, commands: Commands) -> None:
        """Keep and check a step that begins at `now_ns` [ns]."""
        guard, simulator = self._robot.guard, self._robot.simulator
        was, state = self._was, guard.state
        if state is not was:
            self._check_change(was, state, now_ns)
        if state is not TRACK:
            self._impossible = False
        touches = simulator.touches
        new = touches[self._seen if touches is self._list else 0 :]
        self._list, self._seen = touches, len(touches)
        self.touches += [(len(self.rows), touch) for touch in new]
        # Hard braking may command actuators of a robot to 0, too: only the object itself counts.
        is_on = commands is not self._robot.onboard.stopped
        motion = readings.position, readings.velocity, guard.reference, guard.yaw_rate
        others = is_on, simulator.touch_age, now_ns < self._ramp_until_ns
        waits_until_ns = self._alone_ns + self._waits_ns.get(state, LONG_NS)
        mission = self._armed, self._fresh_until_ns, waits_until_ns, self._asked, self._downed
        self.rows.append((now_ns, simulator.steps, state, *motion, *others, *mission))
        self._was, self._state, self._asked, self._downed = state, state, False, False

    def _note(self, now_ns: int, kind: str, text: str) -> None:
        self.breaches.append(Breach(now_ns * 1e-9, kind, text))

    def see_session(self, now_ns: int) -> None:
        """Forget the commands of the old session: the guard has forgotten them, too."""
        self._fresh_until_ns = -1
        self._fresh_ns.clear()
        self._invalid_ns.clear()

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """Check an accepted command's age, count invalid ones; `rejection` is None if accepted."""
        state, self._state = self._state, self._robot.guard.state
        if rejection in INVALID:
            self._invalid_ns.append(now_ns)
            took_ns = now_ns - self._invalid_ns[0]
            if len(self._invalid_ns) == INVALID_COMMANDS and took_ns <= INVALID_NS:
                self._impossible = True
        if rejection is not None:
            return
        basis_ns = command.basis_stamp_ns
        if not 0 <= now_ns - basis_ns <= self._age_ns:
            text = f"accepted a command {(now_ns - basis_ns) * 1e-9:.3f} s old"
            self._note(now_ns, "stale", text)
        self._fresh_until_ns = basis_ns + self._age_ns
        if command.plan:
            end_ns = command.planned_ns + (len(command.plan) + 1) * PLAN_STEP_NS
            end_ns = min(end_ns, now_ns + self._plan_ns)
            self._fresh_until_ns = max(self._fresh_until_ns, end_ns)
        if self._armed and state is HOLD:
            self._fresh_ns.append(now_ns)
        elif self._armed and state is GROUND:
            self._alone_ns = now_ns

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """Store what a request allows the robot to do, which it has carried out at `now_ns`."""
        state, self._state = self._state, self._robot.guard.state
        match request.request:
            case Request.START:
                is_reset = request.start is Start.SPAWN
                if is_reset:
                    self._tracked_ns = -SETTLE_NS
                    self._is_reset, self._asked, self._ramp_until_ns = True, True, -1
                if is_reset or not self._armed:
                    self.see_session(now_ns)
                    self._alone_ns = now_ns
                self._armed = True
            case Request.END:
                self._armed = False
            case Request.ESTOP:
                self._armed, self._asked = False, True
                self._downed |= state in FLOWN
            case Request.ACKNOWLEDGE:
                self._released.add(state)

    def _check_change(self, was: GuardState, state: GuardState, now_ns: int) -> None:
        if was in LATCHED and self._released.isdisjoint(LATCHED) and state is not ESTOP:
            text = f"{was.name} left for {state.name} without the operator"
            self._note(now_ns, "latch", text)
        self._released.intersection_update({state})
        self._armed = self._armed and state not in LATCHED
        self._ramp_until_ns = -1
        if state is TRACK:
            self._enter_track(was, now_ns)
        elif state is HOLD or (was is TRACK and state is GROUND and not self._is_reset):
            # To GROUND: the robot had not left the ground yet.
            self._alone_ns = now_ns
        elif state is LAND and not self._impossible:
            alone_ns = now_ns - self._alone_ns
            if alone_ns <= self._waits_ns.get(was, LONG_NS):
                text = f"LAND out of {was.name} after {alone_ns * 1e-9:.3f} s alone"
                self._note(now_ns, "hold", text)
        if state is not HOLD:
            self._fresh_ns.clear()
        self._is_reset = self._impossible = False

    def _enter_track(self, was: GuardState, now_ns: int) -> None:
        since_ns, self._tracked_ns = now_ns - self._tracked_ns, now_ns
        if since_ns < SETTLE_NS:
            self._note(now_ns, "hold", f"TRACK again after {since_ns * 1e-9:.3f} s")
        if was is HOLD and not self._is_reset:
            self._ramp_until_ns = now_ns + self._ramp_ns
            fresh_ns = self._fresh_ns
            if len(fresh_ns) < RESUME_COMMANDS or fresh_ns[-1] - fresh_ns[0] > RESUME_NS:
                text = f"HOLD left for TRACK on {len(fresh_ns)} fresh commands"
                self._note(now_ns, "stale", text)
