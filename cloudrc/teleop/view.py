# SPDX-License-Identifier: Apache-2.0

"""Show the robot's state to the operator: the newest telemetry, its age, and what comes next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cloudrc.results.metrics.flight import finite
from cloudrc.teleop.interruptions import SILENCE
from cloudrc.teleop.wire import HELD, RobotStatus
from cloudrc.wire.messages import GuardState

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
DRIVEN = "driven"
"""State for `next_step` while the operator drives the robot by hand during a held mission."""
REST = "after a stop or a landing only when it has stood still, well inside the fence"
BY_ITSELF = "without commands the robot holds its position, then goes to LAND, by itself"
NOT_HEARD = f"cloud has no telemetry from the robot: check the link and world; {BY_ITSELF}"
NO_CLOUD = f"teleop does not hear cloud, so there is no telemetry: check cloud; {BY_ITSELF}"
ALONE = {
    GROUND: f"the robot waits for a mission; it starts, {REST}",
    TRACK: "teleop is telling the robot that its mission is over; then the robot holds",
    HOLD: "the robot holds and waits for a mission",
    LAND: "the robot comes to rest and switches off; find the cause, then: cloudrc mission "
    "acknowledge",
    ESTOP: "the robot is switched off; find the cause, then: cloudrc mission acknowledge",
}
"""State of the guard -> what happens next, while no mission is under way."""
IN_MISSION = {
    **ALONE,
    GROUND: f"the robot starts with the mission's first commands, {REST}; if no command comes "
    "within guard.hold_max_s (at least 10 s), the guard goes to LAND",
    TRACK: "the robot follows its mission",
    HOLD: "the robot gets no fresh commands: it continues by itself when they arrive, and goes to "
    "LAND if none arrive within guard.hold_max_s",
}
"""State of the guard -> what happens next, while a mission is under way."""
STEERED = {
    DRIVEN: "the operator drives; to end the drive: cloudrc mission resume, or cancel",
    HELD: "the operator holds the mission; to continue: cloudrc mission resume, or cancel",
}
"""State of a mission -> what happens next, while the robot follows the operator."""


def next_step(guard: GuardState, age: float, cloud_age: float, mission: str | None) -> str:
    """Describe what the robot does next, or what the operator has to do.

    `age` is the age of the telemetry [s], `cloud_age` the age of the last message from cloud [s].
    `mission` is the state of the mission under way: `DRIVEN` while the operator steers the robot by
    hand, None if no mission is under way.
    """
    if age > SILENCE:
        return NO_CLOUD if cloud_age > SILENCE else NOT_HEARD
    if guard is TRACK and mission in STEERED:
        return STEERED[mission]
    return (ALONE if mission is None else IN_MISSION)[guard]


class RobotView:
    """What cloud has said of the robot, and when; all times `now_ns` are [ns], one clock.

    Attributes:
        heard_ns: When the last message from cloud arrived; None before one.
        seen_ns: When the newest telemetry arrived.
    """

    def __init__(self, units: Mapping[str, str]) -> None:
        """Begin without telemetry.

        `units` are the names of the robot's own sensors, as in telemetry, and their units.
        """
        self._units = tuple(units.items())
        self.heard_ns: int | None = None
        self.seen_ns = self._guard_ns = 0  # times of telemetry and of the guard's last change

    def see(self, before: RobotStatus | None, seen: RobotStatus, now_ns: int) -> None:
        """Note that telemetry has arrived at `now_ns`; `before` is the telemetry before it."""
        self.heard_ns = self.seen_ns = now_ns
        if before is None or (before.world, before.guard) != (seen.world, seen.guard):
            self._guard_ns = now_ns

    def cloud_age(self, now_ns: int) -> float | None:
        """Return the age of cloud's last message [s]; None before one."""
        return None if self.heard_ns is None else (now_ns - self.heard_ns) * 1e-9

    def show(self, seen: RobotStatus, mission: str | None, now_ns: int) -> dict[str, Any]:
        """Return what telemetry shows, as the API's `Seen`; `mission` is that of `next_step`."""
        age, control = (now_ns - self.seen_ns) * 1e-9, seen.control
        cloud_age = self.cloud_age(now_ns) or 0.0
        return {
            "age_s": age,
            "epoch": seen.epoch,
            "world": seen.world,
            "position_m": [finite(value) for value in seen.position],
            "guard": seen.guard.name,
            "cause": seen.cause.words,
            "guard_for_s": (now_ns - self._guard_ns) * 1e-9 if age <= SILENCE else None,
            "next_step": next_step(seen.guard, age, cloud_age, mission),
            "obstacle_contacts": seen.obstacle_contacts,
            "touch_speed_mps": finite(seen.touch_speed),
            "sensors": self._sensors(seen.sensors),
            "horizon_s": control and finite(control.horizon),
            "rtt_s": control and finite(control.rtt),
            "loop_delay_s": control and finite(control.loop_delay),
        }

    def _sensors(self, values: tuple[float, ...]) -> list[dict[str, Any]]:
        """Return the robot's own sensors; none if world's robot.yaml is another one."""
        if len(values) != len(self._units):
            return []
        return [
            {"name": name, "value": finite(value), "unit": unit}
            for (name, unit), value in zip(self._units, values, strict=True)
        ]
