# SPDX-License-Identifier: Apache-2.0

"""The guard: the state machine that decides which commands the robot flies.

The guard stands between the tunnel and the low-level controller, and gives the controller a
velocity reference every 2 ms. It trusts only its own clock and the onboard sensors. It assumes that
the cloud is hostile.

                 fresh command of a         command too old, mission over,
                  started mission                   new session
        GROUND -------------------> TRACK ------------------------------> HOLD
          ^                          | ^                                  | |
          |                          | +----------------------------------+ |
          | acknowledged             |     10 fresh commands within 500 ms  | after 60 s, if a
          | after touch-down         |                                      | mission is on
          |                          |   5 impossible commands within 1 s   |
          +------------------------ LAND <----------------------------------+

The *basis* of a command is the odometry from which cloud computed the command. A command is fresh
while its basis is at most `command_age_max_ns` old. A command with a plan stays fresh until the
plan ends, at most for `guard.plan_max_s` after its arrival. The guard does not trust a plan: in
each step it limits the plan's velocity for the present time like the velocity of a new command.

A command is impossible if a number in it is NaN or too large, if a time in it is wrong, such as
the stamp of a basis in the future, or if the robot cannot move that way.

- Every state can change to ESTOP: by the operator's request, or when the robot has turned over,
  because its actuators would then push it in any direction. The operator's acknowledgement leads to
  GROUND.
- In LAND, the operator's acknowledgement leads to HOLD if the robot is in the air. Near the ground
  or on an obstacle, it leads to GROUND at touch-down.
- LAND and ESTOP end the mission. Afterwards only a new start arms the robot again.
- If HOLD begins before the robot has left the ground, GROUND follows at once: the robot switches
  off, and the mission continues. The robot then waits 60 s for cloud's commands.
- HOLD within a mission has a time limit, because the operator may be gone. HOLD after a mission has
  no time limit: the robot waits for the next mission.

A robot whose robot.yaml says `stop: brake` does not descend in LAND: it brakes and, at rest, stops.
A planar robot stays on the ground: the guard ignores its height, and rejects commands with a
vertical velocity as impossible. Its HOLD ends as that of a robot in the air.

A robot that touches nothing never turns over: no command tilts it as far as OVERTURNED_COSINE.
"""

from __future__ import annotations

from collections import Counter, deque
from math import inf

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import DEFAULT_LIMITS, RobotLimits
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.vectors import step_towards
from cloudrc.physics.sim.readings import Readings
from cloudrc.wire.messages import (
    NEVER_NS,
    PLAN_STEP_NS,
    ZERO,
    Cause,
    Command,
    GuardState,
    Vector,
)
from cloudrc.wire.records import GuardChange
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard.hold import Descent, Halt, PositionHold, TakeOff
from cloudrc.world.guard.limits import AGE_MAX_NS, COMMAND_MAX

OVERTURNED_COSINE = 0.2
"""Cosine of the tilt below which the robot counts as turned over, and switches off. Commands
tilt the robot to a cosine of 0.4 at worst; only a collision can tilt it further."""

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState  # looking up a member of an enum is slow

RESUME_COMMANDS = 10
RESUME_NS = 500_000_000
"""RESUME_COMMANDS fresh commands within RESUME_NS [ns] end a HOLD.
Source: docs/safety.md, "Leaving HOLD"."""
SETTLE_NS = 1_000_000_000
"""Shortest time between the beginnings of two HOLDs, and between those of two TRACKs [ns].
Source: docs/safety.md, "Settling time"; docs/reference/faults.md, "F5"."""
INVALID_COMMANDS = 5
IMPOSSIBLE = f"{INVALID_COMMANDS} impossible commands within 1 s"
INVALID_NS = 1_000_000_000
"""INVALID_COMMANDS impossible commands within INVALID_NS [ns] lead to LAND.
Source: docs/reference/faults.md, "F23"."""
FOREVER_NS = 1 << 62
"""Stamp later than all others [ns]: no further velocity of a plan is due."""
NO_COMMAND = Command(NEVER_NS, NEVER_NS, 0, ZERO, 0.0)


def _is_plan_possible(command: Command) -> bool:
    ahead_ns = command.planned_ns - command.basis_stamp_ns
    return 0 <= ahead_ns <= AGE_MAX_NS and rules.within(command.plan, COMMAND_MAX)


class Guard:
    """The state machine of the guard, on world's clock. It begins in the state GROUND.

    Attributes:
        state: Current state.
        cause: Why the guard is in this state; in LAND always the reason of the landing.
        fence: Box that the robot's base may not leave.
        box: Corners of the box in which commands move the robot [m]; a planar robot has no height.
        armed: Whether a mission is active: from the operator's start to its end, LAND or ESTOP.
        reference: Velocity reference of the last step [m/s], world frame, shape (3,).
        yaw_rate: Limited yaw rate [rad/s]; not every onboard controller obeys it.
        command_age_max_ns: Largest accepted age of the odometry from which cloud computed a command
            [ns].
        acceleration_max: Largest rate of change of the velocity reference [m/s^2].
        stop_coefficient: Braking distance divided by the square of the speed [s^2/m].
        take_off: What the guard knows of the take-off.
        changes: Changes of the state since the last `take_changes`.
        counts: Counters of world. The guard counts "limited_speed": shortened velocities of
            commands and plans; "limited_yaw_rate": commands with a limited yaw rate;
            "limited_fence": steps in which the fence limited the reference.
    """

    def __init__(
        self,
        limits: ResolvedGuard,
        fence: Fence,
        robot: RobotLimits = DEFAULT_LIMITS,
    ) -> None:
        """Begin in GROUND, inside `fence`, which has a height if the robot stays on the ground.

        `robot` tells how fast the robot brakes and how it lands.
        """
        self.command_age_max_ns = round(limits.command_age_max_ms * 1_000_000)
        self._hold_max_ns = round(limits.hold_max_s * 1e9)
        self._plan_max_ns = round(limits.plan_max_s * 1e9)
        self._ramp_ns = rules.ramp_ns(limits.speed_max_mps, robot.braking_mps2)
        self.acceleration_max = limits.acceleration_max_mps2
        self._yaw_rate_max = limits.yaw_rate_max_radps
        self._speed_max = limits.speed_max_mps * rules.ROUNDING_FACTOR
        self._braking, self._planar = robot.braking_mps2, fence.ground is not None
        self.stop_coefficient = rules.stop_coefficient(self._braking)
        self.fence = fence
        self._low, self._high = fence.inner_low, fence.inner_high
        if self._planar:
            self._low, self._high = (*self._low[:2], -inf), (*self._high[:2], inf)
        self.box = self._low, self._high
        self._floor, half = self._low[2], 0.5 * limits.speed_max_mps
        self._position_hold = PositionHold(self._low, self._high, half, self._braking)
        self._descent = Halt() if robot.stop == "brake" else Descent(self._floor, half)
        self.take_off = TakeOff(fence)
        self.changes: list[GuardChange] = []
        self.counts: Counter[str] = Counter()
        self.state, self.cause = GROUND, Cause.SPAWN
        self.armed = self._flies = False
        self.yaw_rate, self._alone_ns = 0.0, 0
        self.reference = self._wanted = ZERO
        self._track_until_ns = self._ramp_until_ns = NEVER_NS
        self._tracked_ns = self._held_ns = -SETTLE_NS
        self._played = NO_COMMAND  # the newest command of a mission
        self._next_ns = FOREVER_NS  # when the plan's next velocity is due
        self._fresh_ns: deque[int] = deque(maxlen=RESUME_COMMANDS)
        self._invalid_ns: deque[int] = deque(maxlen=INVALID_COMMANDS)

    @property
    def brakes(self) -> bool:
        """Whether the robot is in HOLD or LAND and still brakes."""
        return self._position_hold.brakes

    @property
    def latched(self) -> bool:
        """Whether the state is LAND or ESTOP, which only the operator's acknowledgement ends."""
        return self.state is LAND or self.state is ESTOP

    @property
    def _alone_max_ns(self) -> int:
        """How long a robot in a mission waits for cloud's commands before LAND [ns]."""
        hold_ns = self._hold_max_ns
        return hold_ns if self._flies else max(hold_ns, rules.GROUND_WAIT_MIN_NS)

    def take_changes(self) -> list[GuardChange]:
        """Return the changes of the state since the last call."""
        changes, self.changes = self.changes, []
        return changes

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Enter GROUND because of `cause`; the robot was reset to its spawn, switched off."""
        self.forget_commands()
        self._tracked_ns = self._held_ns = -SETTLE_NS
        self._enter(GROUND, now_ns, Cause.SPAWN, cause)

    def start_mission(self, now_ns: int) -> None:
        """Arm the robot for a mission; from now on the robot flies fresh commands.

        In LAND or ESTOP nothing happens, because the operator has to acknowledge first.
        """
        if self.latched:
            return
        if not self.armed:
            self.forget_commands()  # only commands of this mission count
            self._alone_ns = now_ns
        self.armed = True

    def end_mission(self, now_ns: int) -> None:
        """End the mission: hold the position until the operator starts the next mission."""
        was_armed, self.armed = self.armed, False
        if self.state is TRACK:
            self._enter(HOLD, now_ns, Cause.ENDED)
        elif self.state is HOLD and was_armed:  # from now on this HOLD interrupts no mission
            self.cause = Cause.ENDED
            self.changes.append(GuardChange(now_ns, HOLD, Cause.ENDED.words))

    def stop(self, now_ns: int) -> None:
        """Switch the robot off at once, in any state."""
        if self.state is not ESTOP:
            self._enter(ESTOP, now_ns, Cause.STOPPED)

    def fail(self, now_ns: int) -> None:
        """Switch off the actuators because the onboard controller cannot steer them, in any state.

        Braking and landing need the onboard controller, too, so they are no way out.
        """
        if self.state is not ESTOP:
            self._enter(ESTOP, now_ns, Cause.FAILED)

    def acknowledge(self, now_ns: int) -> None:
        """Process the operator's acknowledgement of LAND or ESTOP; nothing starts."""
        if self.latched and not self._flies:
            self._enter(GROUND, now_ns, self.take_off.condition)
        elif self.state is LAND:
            self._descent.acknowledged = True

    def forget_commands(self) -> None:
        """Forget earlier commands, because a new session or mission begins."""
        self._track_until_ns = NEVER_NS
        self._fresh_ns.clear()
        self._invalid_ns.clear()
        self._wanted, self.yaw_rate, self._next_ns = ZERO, 0.0, FOREVER_NS

    def accept_command(self, command: Command, now_ns: int) -> str | None:
        """Accept a command at `now_ns` [ns] and return None, or return the reason to reject it.

        The reason is "range" for a number that is too large or NaN and for an impossible plan, and
        "vertical" for a vertical velocity of a planar robot.
        It is "stale" if the odometry from which cloud computed the command is too old, and "future"
        if this odometry is later than `now_ns`.
        """
        reason = self._reason_to_reject(command, now_ns)
        if reason is None:
            if self.armed:
                self._obey(command, now_ns)
        elif reason != "stale":  # a slow link is no sign of a hostile cloud
            self._note_invalid(now_ns)
        return reason

    def _reason_to_reject(self, command: Command, now_ns: int) -> str | None:
        x, y, z = command.velocity
        most, yaw_rate = COMMAND_MAX, command.yaw_rate
        if not (abs(x) <= most and abs(y) <= most and abs(z) <= most and abs(yaw_rate) <= most):
            return "range"
        age_ns = now_ns - command.basis_stamp_ns
        if age_ns < 0:
            return "future"
        if age_ns > self.command_age_max_ns:
            return "stale"
        if command.plan and not _is_plan_possible(command):
            return "range"
        if self._planar and (z or any(planned[2] for planned in command.plan)):
            return "vertical"
        return None

    def _obey(self, command: Command, now_ns: int) -> None:
        """Take an accepted command of the mission; change to TRACK if it is time."""
        fresh_until_ns = command.basis_stamp_ns + self.command_age_max_ns
        self._play(command, now_ns)
        most, self.yaw_rate = self._yaw_rate_max, command.yaw_rate
        if not -most <= self.yaw_rate <= most:
            self.yaw_rate = rules.clamp(self.yaw_rate, -most, most)
            self.counts["limited_yaw_rate"] += 1
        if self.state is GROUND:
            self._alone_ns = now_ns
            if self._settled(now_ns, fresh_until_ns):
                self._enter(TRACK, now_ns, Cause.COMMAND)
        elif self.state is HOLD:
            self._leave_hold(now_ns, fresh_until_ns)
        if self.state is TRACK:
            self._track_until_ns = fresh_until_ns
            if command.plan:
                self._track_until_ns = max(fresh_until_ns, self._plan_end_ns(command, now_ns))

    def _plan_end_ns(self, command: Command, now_ns: int) -> int:
        """Return until when [ns] the robot may follow a plan that arrives at `now_ns` [ns]."""
        end_ns = command.planned_ns + (len(command.plan) + 1) * PLAN_STEP_NS
        return min(end_ns, now_ns + self._plan_max_ns)

    def _play(self, command: Command, now_ns: int) -> None:
        """Take the wanted velocity for `now_ns` [ns] from a command, or from the command's plan."""
        velocity, self._played, self._next_ns = command.velocity, command, FOREVER_NS
        if command.plan:
            velocity = command.velocity_at(now_ns)
            step = max(now_ns - command.planned_ns, 0) // PLAN_STEP_NS
            if step < len(command.plan):
                self._next_ns = command.planned_ns + (step + 1) * PLAN_STEP_NS
        self._wanted = rules.limit_length(velocity, self._speed_max)
        if self._wanted is not velocity:
            self.counts["limited_speed"] += 1

    def _leave_hold(self, now_ns: int, fresh_until_ns: int) -> None:
        self._fresh_ns.append(now_ns)
        took_ns = now_ns - self._fresh_ns[0]
        enough = len(self._fresh_ns) == RESUME_COMMANDS and took_ns <= RESUME_NS
        if enough and self._settled(now_ns, fresh_until_ns):
            text = f"{RESUME_COMMANDS} fresh commands within {took_ns * 1e-9:.3f} s"
            self._enter(TRACK, now_ns, Cause.COMMANDS, text)
            self._ramp_until_ns = now_ns + self._ramp_ns

    def _settled(self, now_ns: int, fresh_until_ns: int) -> bool:
        """Return whether TRACK may begin at `now_ns`; prevent fast changes between TRACK and HOLD.

        Take-off must be allowed, and the last TRACK must have begun at least SETTLE_NS ago. The
        last HOLD must have begun at least SETTLE_NS before `fresh_until_ns`: at this time the
        present command becomes too old, and the next HOLD may begin.
        """
        apart_ns = min(fresh_until_ns - self._held_ns, now_ns - self._tracked_ns)
        return self.take_off.allowed and apart_ns >= SETTLE_NS

    def _note_invalid(self, now_ns: int) -> None:
        self._invalid_ns.append(now_ns)
        if len(self._invalid_ns) < INVALID_COMMANDS or now_ns - self._invalid_ns[0] > INVALID_NS:
            return
        if self.armed and self.state is not GROUND:
            self._enter(LAND, now_ns, Cause.IMPOSSIBLE, IMPOSSIBLE)

    def step(self, now_ns: int, readings: Readings, dt: float) -> Vector | None:
        """Run one step of `dt` [s] at `now_ns` [ns], world's clock.

        Return the velocity reference for the low-level controller [m/s], world frame, shape (3,).
        Return None while the robot is switched off.
        """
        if self._planar:
            readings = readings.on_ground()
        if now_ns >= self._next_ns:
            self._play(self._played, now_ns)
        if self._flies and readings.axes[8] < OVERTURNED_COSINE:
            self._enter(ESTOP, now_ns, Cause.OVERTURNED)
        elif not self.take_off.over:
            self.take_off.look(readings, self._flies)
        if now_ns <= self._track_until_ns:
            change_max = self.acceleration_max * dt
            reference = step_towards(self.reference, self._wanted, change_max)
        else:
            self._look_after_itself(now_ns, readings)
            if not self._flies:
                return None
            sink = self._descent.speed if self.state is LAND else 0.0
            reference = self._position_hold.follow(self.reference, readings, sink, dt)
        self._follow(reference, now_ns, readings, dt)
        return self.reference

    def plain_track(self, now_ns: int) -> tuple[int, Vector, int] | None:
        """Return the values with which C (`step.c`) runs `step` from `now_ns` [ns] on.

        The values are: start of the plan's next velocity [ns], commanded velocity [m/s], and end of
        the time in which the robot may follow the command or plan [ns].
        Return None in all cases that only `step` handles, such as HOLD.
        """
        if not self._ramp_until_ns <= now_ns <= self._track_until_ns:
            return None
        if self._planar and not self.take_off.over:  # the next step ends its take-off
            return None
        if now_ns >= self._next_ns:
            self._play(self._played, now_ns)
        return self._next_ns, self._wanted, self._track_until_ns

    def stands_until(self, now_ns: int, until_ns: int) -> int:
        """Return up to when C (`step.c`) runs `step` of a robot on the ground [ns].

        This is at most `until_ns`; it is `now_ns` if only `step` handles the next step.
        """
        if self.state is not GROUND or not self.take_off.allowed_at_once:
            return now_ns
        if self.armed:
            until_ns = min(until_ns, self._alone_ns + self._alone_max_ns + 1)
        return min(until_ns, self._next_ns)

    def _follow(self, reference: Vector, now_ns: int, readings: Readings, dt: float) -> None:
        """Store a velocity reference, limited to keep the robot upright and inside the fence."""
        climb, position, stop = readings.velocity[2], readings.position, self.stop_coefficient
        if reference[2] < climb - rules.SINK_LEAD_MAX:
            reference = rules.limit_sink(reference, self.reference, climb, self._speed_max)
        inside = rules.limit_to_fence(reference, position, self._low, self._high, stop)
        if inside != reference:
            self.counts["limited_fence"] += 1
            step = self.acceleration_max * dt
            inside = rules.limit_growth(self.reference, inside, step)
            reference = rules.limit_length(inside, self._speed_max)
        if now_ns < self._ramp_until_ns:
            reference = rules.limit_growth(self.reference, reference, self._braking * dt)
        self.reference = reference

    def _look_after_itself(self, now_ns: int, readings: Readings) -> None:
        """Change the guard's state if necessary, in a step without a fresh command."""
        state = self.state
        if state is TRACK and self._track_until_ns == NEVER_NS:
            self._enter(HOLD, now_ns, Cause.SESSION)
        elif state is TRACK:
            age_ns = now_ns - self._played.basis_stamp_ns
            limit = self.command_age_max_ns * 1e-9
            ended = ", and its plan has ended" if self._played.plan else ""
            text = f"command age {age_ns * 1e-9:.3f} s above {limit:.3f} s{ended}"
            self._enter(HOLD, now_ns, Cause.SILENCE, text)
        elif self.armed and now_ns - self._alone_ns > self._alone_max_ns:
            text = f"held for {self._alone_max_ns * 1e-9:g} s without the cloud"
            self._enter(LAND, now_ns, Cause.ALONE, text)
            self._flies = state is HOLD  # not in GROUND
        elif state is LAND and self._flies:
            if self._descent.may_stop(readings):
                self._enter(HOLD, now_ns, Cause.NOT_DOWN)
            elif self._descent.is_over(now_ns, self.reference, readings):
                state = GROUND if self._descent.acknowledged else LAND
                self._enter(state, now_ns, Cause.DOWN)
                self._flies, self.reference = False, ZERO
                self.take_off.forget(stopped=True)  # the robot may slide off an obstacle
        if self.state is HOLD and self.take_off.may_end(readings):
            self._enter(GROUND, now_ns, Cause.NOT_OFF)

    def _enter(self, state: GuardState, now_ns: int, cause: Cause, text: str = "") -> None:
        """Change the state and record the change with `text`, by default the text of the cause."""
        self.cause = self.cause if cause is Cause.DOWN and state is LAND else cause
        if self.state is not HOLD or state is not LAND:  # LAND descends from the hold point
            self._position_hold.forget()
        self.state, self._flies = state, state is not GROUND and state is not ESTOP
        self._track_until_ns = self._ramp_until_ns = NEVER_NS
        self._low = (*self._low[:2], -inf if state is LAND else self._floor)
        if state is TRACK:
            self._tracked_ns = now_ns
        elif state is HOLD:
            self._held_ns = self._alone_ns = now_ns
            self._fresh_ns.clear()
        else:
            self.armed = self.armed and cause is Cause.NOT_OFF
            self._descent.begin(now_ns)
            if state is not LAND:
                self.reference = ZERO
                self.take_off.forget(stopped=state is ESTOP)
        self.changes.append(GuardChange(now_ns, state, text or cause.words))
