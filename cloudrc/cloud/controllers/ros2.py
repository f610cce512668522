# SPDX-License-Identifier: Apache-2.0

"""Controller: a node of ROS 2, which answers each estimate with a velocity.

Source: docs/reference/ros2.md.
"""

from __future__ import annotations

from math import isnan
from typing import Any

from cloudrc.cloud.controllers.remote import OutsideController
from cloudrc.config.schema import Positive, RosNamespace
from cloudrc.wire.messages import Odometry, Setpoint


class RosController(OutsideController):
    """Asks a node of ROS 2; it also gets the odometry as it has arrived, delays and the time."""

    transport = "ros2"

    def observe(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> dict[str, Any]:
        """Return what the node gets to know; `dt` is the period [s]."""
        now_ns, newest, loop_delay, horizon = self.surroundings()
        return {
            **super().observe(estimate, setpoint, dt),
            "now_ns": now_ns,
            # A message of odometry has the fields of `Odometry`, in their order.
            "measured": None if newest is None else tuple(newest),
            "loop_delay": 0.0 if isnan(loop_delay) else loop_delay,
            "horizon": horizon,
        }


def build(namespace: RosNamespace = "", start_limit_s: Positive = 60.0) -> RosController:
    """Make the controller.

    Args:
        namespace: Namespace of the topics, such as drone1; empty for /cloudrc/estimate and others.
        start_limit_s: Time limit for the first answer of an episode [s].
    """
    return RosController(namespace, start_limit_s)
