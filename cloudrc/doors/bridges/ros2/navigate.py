# SPDX-License-Identifier: Apache-2.0

"""Serve Nav2's action NavigateToPose with a robot of cloudrc."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionServer, CancelResponse

from cloudrc.doors.bridges.ros2.mission import Navigation
from cloudrc.results.record.live import WORLD
from cloudrc.wire.messages import Quaternion, Vector

UNKNOWN = 9000
"""Error code of a flight that did not get to its goal, in the range of this action."""


def serve_navigation(
    node: Any,
    navigation: Navigation,
    read_goal: Callable[[Any], tuple[str, Vector, Quaternion]],
    group: Any,
) -> ActionServer:
    """Serve `navigate_to_pose` at `node`; `read_goal` reads a PoseStamped."""

    def execute(handle: Any) -> Any:
        goal = handle.request.pose

        def tell(position: Vector, away: float, since: float) -> None:
            feedback = NavigateToPose.Feedback(distance_remaining=away)
            here, time = feedback.current_pose, feedback.navigation_time
            here.header.frame_id = goal.header.frame_id or WORLD
            here.pose.position.x, here.pose.position.y, here.pose.position.z = position
            time.sec, time.nanosec = divmod(round(since * 1e9), 1_000_000_000)
            handle.publish_feedback(feedback)

        why = navigation.fly(read_goal(goal), lambda: handle.is_cancel_requested, tell)
        result = NavigateToPose.Result()
        if not why:
            handle.succeed()
            return result
        handle.canceled() if handle.is_cancel_requested else handle.abort()
        for name, value in (("error_code", UNKNOWN), ("error_msg", why)):
            if hasattr(result, name):  # Humble has neither
                setattr(result, name, value)
        return result

    return ActionServer(
        node,
        NavigateToPose,
        "navigate_to_pose",
        execute,
        callback_group=group,
        cancel_callback=lambda _: CancelResponse.ACCEPT,
    )
