# SPDX-License-Identifier: Apache-2.0

"""Remember the plans of the sent commands, and tell what the plan in use had predicted.

Telemetry echoes the command that the robot follows. The plan of this command has predicted where
the robot is at the instant of the telemetry's odometry. So the accuracy of plans can be judged at
the instants at which the robot follows them, and not only at their beginning.
"""

from __future__ import annotations

from collections.abc import Sequence

from cloudrc.wire.messages import PLAN_STEP_NS, Command, GuardState, Telemetry, Vector
from cloudrc.wire.records import PlanFollowed

TRACK = GuardState.TRACK  # looking up a member of an enum is slow


class PlanLog:
    """The plans of a session's commands that the robot may still follow.

    Attributes:
        plans: The plans, oldest first. Stamp of the command [ns], cloud's clock -> beginning of its
            plan [ns], world's clock, and the predicted positions [m]: one at the beginning, and one
            after each PLAN_STEP_NS.
    """

    def __init__(self) -> None:
        self.plans: dict[int, tuple[int, Sequence[Vector]]] = {}

    def add(self, command: Command, positions: Sequence[Vector]) -> None:
        """Store the `positions` [m] that the plan of a command predicts."""
        self.plans[command.stamp_ns] = command.planned_ns, positions

    def look_up(self, telemetry: Telemetry, now_ns: int) -> PlanFollowed | None:
        """Return what the plan in use predicted; telemetry arrived at `now_ns` [ns], cloud's clock.

        Return None if the robot follows no plan, or if its plan has ended.
        """
        plans, echo_ns = self.plans, telemetry.echo_stamp_ns
        while plans and (oldest := next(iter(plans))) < echo_ns:
            del plans[oldest]  # the robot follows a newer command
        if telemetry.guard is not TRACK or echo_ns not in plans:
            return None
        begin_ns, positions = plans[echo_ns]
        # A command that arrives early is followed before its plan begins.
        step, rest_ns = divmod(max(telemetry.stamp_ns - begin_ns, 0), PLAN_STEP_NS)
        if step + 1 >= len(positions):
            return None
        (ax, ay, az), (bx, by, bz) = positions[step], positions[step + 1]
        share = rest_ns / PLAN_STEP_NS
        position = (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az))
        return PlanFollowed(now_ns, telemetry.stamp_ns, position)
