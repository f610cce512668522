# SPDX-License-Identifier: Apache-2.0

"""Carry out what nodes of ROS 2 ask the robot for, with teleop's API."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import cos, degrees, dist, hypot, inf, isfinite, pi, radians, remainder, sin

from cloudrc.base.text import describe_point
from cloudrc.config.heading import WHY, Heading
from cloudrc.config.schema import YAW_TOLERANCE_DEG
from cloudrc.doors.bridges.ros2.description import RobotFrames
from cloudrc.doors.console.steering import Steering
from cloudrc.physics.geometry.vectors import turn_to
from cloudrc.results.record.live import WORLD
from cloudrc.wire.messages import ZERO, Quaternion, Vector

WITHOUT_PREFIX = RobotFrames()
DRIVE_LASTS = 0.5
"""Time for which a velocity is flown [s]; then the robot holds, unless a new one has arrived."""
DRIVE_PERIOD = 0.05
"""Time between two velocities that are passed on [s]; nodes may send them much faster."""
HEIGHT = 1.0
"""Least height of a goal that has none [m]."""
SAID_AGAIN = 5.0
"""Time after which the same words are said again [s]."""
OBSERVES = (
    "this bridge only observes; start it without --observe, in the cluster with ros.steer=true"
)


class RosRequests:
    """Passes the requests of nodes on to teleop; says in one line what it does not take.

    Attributes:
        position: The robot's newest position [m], world frame, shape (3,).
        yaw: Its newest yaw [rad].
        refusal: The newest goal that was refused, in words, and why; () if there is none.
    """

    def __init__(
        self,
        steering: Steering,
        tell: Callable[[str], None],
        *,
        planar: bool,
        heading: Heading,
        frames: RobotFrames = WITHOUT_PREFIX,
        observes: bool = False,
    ) -> None:
        """Make it.

        Args:
            steering: Sends requests to teleop.
            tell: Gets words for the user.
            planar: Whether the robot stays on the ground.
            heading: What decides about its heading.
            frames: Names of the robot's frames.
            observes: Whether to take no request.
        """
        self._steering, self._tell_user = steering, tell
        self._planar, self._heading = planar, heading
        self._frames, self._observes = frames, observes
        self.position: Vector = ZERO
        self.yaw = 0.0
        self.refusal: tuple[str, ...] = ()
        self._goal: Vector = ZERO
        self._goal_yaw: float | None = None  # [rad]; None: any
        # Velocity, end of its time [s], yaw rate [rad/s].
        self._wanted: tuple[Vector, float, float | None] | None = None
        self._passed = -inf  # time at which the newest velocity was passed on [s]
        self._said: dict[str, float] = {}  # words -> when they were said last [s]

    def serve(self, name: str) -> tuple[bool, str]:
        """Carry out a verb of the operator; return whether teleop accepted it, and words."""
        if self._observes:
            self._tell(f"{name}: {OBSERVES}")
            return False, OBSERVES
        answer = self._steering.act(name)
        if answer.is_refusal and name == "estop":
            self._steering.stop()  # asks again until teleop answers
        return not answer.is_refusal, answer.text

    def go_to(self, frame: str, position: Sequence[float], wxyz: Quaternion) -> str:
        """Let the robot go to a pose: `position` [m] and orientation `wxyz` [1] in `frame`.

        Return why it does not; "" if it does.
        """
        x, y, z = position
        yaw_deg = None
        why = self._refuse("goal_pose", frame, self._frames.ground, (*position, *wxyz))
        if not why:
            yaw_deg = _yaw_deg(wxyz)
            if self._heading == "fixed" and abs(yaw_deg or 0.0) > YAW_TOLERANCE_DEG:
                why = f"yaw {yaw_deg:.0f} degrees: {WHY['fixed']}; give the goal the yaw 0"
                self._tell(f"goal_pose: {why}")
        if not why:
            if z == 0.0:  # RViz clicks on the ground
                z = max(self.position[2], HEIGHT)
            self._goal = (x, y, self.position[2] if self._planar else z)
            place = (x, y) if self._planar else self._goal
            self._goal_yaw = None if yaw_deg is None else radians(yaw_deg)
            answer = self._steering.go_to(place, None if self._heading == "fixed" else yaw_deg)
            self._tell(answer.text)
            why = answer.text if answer.is_refusal else ""
        if why:
            self.refusal = f"{describe_point(position)} m in {frame or WORLD}", why
        return why

    def stay(self) -> None:
        """Let the robot go to where it is."""
        self.go_to(WORLD, self.position, (0.0, 0.0, 0.0, 0.0))

    @property
    def distance(self) -> float:
        """Distance to the newest goal [m]."""
        return dist(self.position, self._goal)

    @property
    def has_heading(self) -> bool:
        """Whether the robot has the heading of the newest goal, if that has one."""
        if self._goal_yaw is None:
            return True
        return abs(remainder(self._goal_yaw - self.yaw, 2 * pi)) <= radians(YAW_TOLERANCE_DEG)

    def drive(self, frame: str, linear: Sequence[float], yaw_rate: float) -> None:
        """Drive with a velocity in `frame`; an empty frame is that of the base.

        Args:
            frame: Frame of the velocity.
            linear: Velocity [m/s], shape (3,).
            yaw_rate: Yaw rate [rad/s].
        """
        base = self._frames.base
        frame = frame or base
        if self._refuse("cmd_vel", frame, (base, *self._frames.ground), (*linear, yaw_rate)):
            return
        if yaw_rate and self._heading == "fixed":
            self._tell(f"cmd_vel: angular.z is ignored: {WHY['fixed']}")
            yaw_rate = 0.0
        x, y, z = linear
        # A turn is flown in the frame of the robot's heading, a plain velocity in the world's.
        turn = (frame == base) * self.yaw - (self.yaw if yaw_rate else 0.0)
        if turn:
            x, y = x * cos(turn) - y * sin(turn), x * sin(turn) + y * cos(turn)
        velocity = x, y, 0.0 if self._planar else z
        self._wanted = velocity, time.monotonic() + DRIVE_LASTS, yaw_rate or None

    def pass_on(self) -> None:
        """Pass the newest velocity on, if it is due; say why teleop has not taken a request."""
        now = time.monotonic()
        wanted = self._wanted
        if wanted is not None and now - self._passed >= DRIVE_PERIOD:
            self._passed, self._wanted = now, None
            velocity, until, turn = wanted
            self._steering.hold_key("cmd_vel", velocity, until - now, turn)
        text, is_refusal, said = self._steering.answer
        if is_refusal and max(now - self._passed, now - said) < DRIVE_LASTS:
            self._tell(text)

    def see(self, position: Vector, wxyz: Quaternion) -> None:
        """Note where the robot is: `position` [m] and orientation `wxyz` [1]."""
        self.position, self.yaw = position, -turn_to(0.0, wxyz)

    def _refuse(
        self, topic: str, frame: str, known: Sequence[str], numbers: Sequence[float]
    ) -> str:
        """Say why a message is not taken; "" if it is."""
        why = ""
        if self._observes:
            why = OBSERVES
        elif frame and frame not in known:
            why = f"unknown frame '{frame}'; use {' or '.join(known)}"
        elif not all(map(isfinite, numbers)):
            why = "a number is not finite"
        if why:
            self._tell(f"{topic}: {why}")
        return why

    def _tell(self, text: str) -> None:
        now = time.monotonic()
        if now - self._said.get(text, -inf) > SAID_AGAIN:
            self._said[text] = now
            self._tell_user(text)


def _yaw_deg(wxyz: Quaternion) -> float | None:
    """Return the yaw of an orientation [deg], None if it is 0; users type one of any length."""
    length = hypot(*wxyz)
    if not length:
        return None
    w, x, y, z = (number / length for number in wxyz)
    return degrees(-turn_to(0.0, (w, x, y, z)))
