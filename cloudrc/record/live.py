"""Encode and decode the messages that cloudrc exchanges with live nodes of ROS 2.

Frames and units are those of a recording: poses are in the frame `world`, and the twist of an
odometry is in its child frame `base_link`, as REP-103 and REP-105 say.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from typing import Any

from cloudrc.messages import Quaternion, Vector
from cloudrc.record.ros import STORE, encode, header, part
from cloudrc.record.topics import TOPICS

WORLD = "world"
"""Frame of poses and of commanded velocities."""
_ODOMETRY = TOPICS["/odometry"]
_STAMPED = "geometry_msgs/msg/TwistStamped"


def encode_odometry(
    stamp_ns: int,
    position: Sequence[float],
    orientation_wxyz: Quaternion,
    velocity: Sequence[float],
    angular_velocity_body: Sequence[float],
) -> bytes:
    """Encode a nav_msgs/Odometry as CDR.

    Args:
        stamp_ns: Time of the state [ns].
        position: Position [m], world frame, shape (3,).
        orientation_wxyz: Orientation [1], body to world, shape (4,).
        velocity: Velocity [m/s], world frame, shape (3,).
        angular_velocity_body: Angular velocity [rad/s], body frame, shape (3,).
    """
    row = (stamp_ns, position, orientation_wxyz, velocity, angular_velocity_body)
    return encode(_ODOMETRY, row)


def encode_pose(stamp_ns: int, position: Sequence[float], yaw: float) -> bytes:
    """Encode a geometry_msgs/PoseStamped as CDR: `position` [m], world frame, and `yaw` [rad]."""
    turn = part("geometry_msgs/msg/Quaternion", 0.0, 0.0, sin(yaw / 2), cos(yaw / 2))
    pose = part("geometry_msgs/msg/Pose", part("geometry_msgs/msg/Point", *position), turn)
    return _pack("geometry_msgs/msg/PoseStamped", header(stamp_ns), pose)


def encode_span(stamp_ns: int, duration: float) -> bytes:
    """Encode a sensor_msgs/TimeReference as CDR: `duration` [s] from time_ref to its stamp."""
    begin = header(stamp_ns - round(duration * 1e9)).stamp
    return _pack("sensor_msgs/msg/TimeReference", header(stamp_ns, ""), begin, "")


def encode_clock(now_ns: int) -> bytes:
    """Encode a rosgraph_msgs/Clock as CDR: `now_ns` is the time [ns]."""
    return _pack("rosgraph_msgs/msg/Clock", header(now_ns).stamp)


def _pack(ros_type: str, *values: Any) -> bytes:
    return bytes(STORE.serialize_cdr(part(ros_type, *values), ros_type, little_endian=True))


def decode_stamped_twist(data: bytes) -> tuple[int, str, Vector, float]:
    """Decode a geometry_msgs/TwistStamped.

    Return stamp [ns], frame, linear velocity [m/s], and angular velocity about z [rad/s].
    """
    message: Any = STORE.deserialize_cdr(data, _STAMPED)
    stamp, twist = message.header.stamp, message.twist
    linear = (twist.linear.x, twist.linear.y, twist.linear.z)
    return (
        stamp.sec * 1_000_000_000 + stamp.nanosec,
        message.header.frame_id,
        linear,
        twist.angular.z,
    )


def decode_twist(data: bytes) -> tuple[Vector, float]:
    """Decode a geometry_msgs/Twist: linear velocity [m/s], angular velocity about z [rad/s]."""
    twist: Any = STORE.deserialize_cdr(data, "geometry_msgs/msg/Twist")
    return (twist.linear.x, twist.linear.y, twist.linear.z), twist.angular.z
