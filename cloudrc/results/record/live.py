# SPDX-License-Identifier: Apache-2.0

"""Encode and decode the messages that cloudrc exchanges with live nodes of ROS 2.

Frames and units are those of a recording: poses are in the frame `world`, and the twist of an
odometry is in its child frame `base_link`, as REP-103 and REP-105 say.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import cos, sin
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.results.record.ros import STORE, header, pack, stamp_of, twist_of
from cloudrc.wire.messages import UPRIGHT, Quaternion, Vector
from cloudrc.wire.records import Control
from cloudrc.wire.rotation import rotate

WORLD, BASE = "world", "base_link"
"""Frame of poses and of commanded velocities, and frame of the robot's base."""
Covariance: TypeAlias = NDArray[np.float64]
"""Covariance of six values, in SI units, shape (36,)."""
EXACT: Covariance = np.zeros(36)
"""That of values without errors, or with unknown ones."""
Pose: TypeAlias = tuple[Sequence[float], Sequence[float]]
"""Position [m], shape (3,), and orientation wxyz [1], shape (4,)."""


def encode_odometry(
    stamp_ns: int,
    position: Sequence[float],
    orientation_wxyz: Quaternion,
    velocity: Sequence[float],
    angular_velocity_body: Sequence[float],
    child: str = BASE,
    parent: str = WORLD,
    covariances: tuple[Covariance, Covariance] = (EXACT, EXACT),
) -> bytes:
    """Encode a nav_msgs/Odometry as CDR.

    Args:
        stamp_ns: Time of the state [ns].
        position: Position [m], world frame, shape (3,).
        orientation_wxyz: Orientation [1], body to world, shape (4,).
        velocity: Velocity [m/s], world frame, shape (3,).
        angular_velocity_body: Angular velocity [rad/s], body frame, shape (3,).
        child: Name of the body frame.
        parent: Name of the frame of the pose; its origin and axes are the world's.
        covariances: Those of pose and twist.
    """
    w, x, y, z = orientation_wxyz
    pose = position, (x, y, z, w)
    twist = rotate((w, -x, -y, -z), velocity), angular_velocity_body
    covered = zip((pose, twist), covariances, strict=True)
    return pack("nav_msgs/msg/Odometry", header(stamp_ns, parent), child, *covered)


def covariance(linear: float, angular: float) -> Covariance:
    """Return the covariance of three linear and three angular values with these deviations.

    The standard deviations are in [m] and [rad], or in [m/s] and [rad/s].
    """
    return np.diag(np.square([linear] * 3 + [angular] * 3)).ravel()


def encode_pose(stamp_ns: int, position: Sequence[float], yaw: float) -> bytes:
    """Encode a geometry_msgs/PoseStamped as CDR: `position` [m], world frame, and `yaw` [rad]."""
    pose = position, (0.0, 0.0, sin(yaw / 2), cos(yaw / 2))
    return pack("geometry_msgs/msg/PoseStamped", header(stamp_ns), pose)


def encode_span(stamp_ns: int, duration: float) -> bytes:
    """Encode a sensor_msgs/TimeReference as CDR: `duration` [s] from time_ref to its stamp."""
    begin, _ = header(stamp_ns - round(duration * 1e9))
    return pack("sensor_msgs/msg/TimeReference", header(stamp_ns, ""), begin, "")


def encode_clock(now_ns: int) -> bytes:
    """Encode a rosgraph_msgs/Clock as CDR: `now_ns` is the time [ns]."""
    return pack("rosgraph_msgs/msg/Clock", header(now_ns)[0])


def frames_of(control: Control, prefix: str = "") -> dict[str, Pose]:
    """Return the frames of a control period, in `world`; `prefix` precedes their names."""
    return {
        f"{prefix}estimate": (control.position, control.orientation_wxyz),
        f"{prefix}setpoint": (control.setpoint, UPRIGHT),
    }


def encode_transforms(stamp_ns: int, poses: Mapping[str, Pose], parent: str = WORLD) -> bytes:
    """Encode a tf2_msgs/TFMessage as CDR: frame -> its pose in `parent` at `stamp_ns` [ns]."""
    return encode_tree(stamp_ns, {parent: poses})


def encode_tree(stamp_ns: int, tree: Mapping[str, Mapping[str, Pose]]) -> bytes:
    """Encode a tf2_msgs/TFMessage likewise: parent -> frame -> its pose in the parent."""
    transforms = [
        (header(stamp_ns, parent), frame, (position, (x, y, z, w)))
        for parent, poses in tree.items()
        for frame, (position, (w, x, y, z)) in poses.items()
    ]
    return pack("tf2_msgs/msg/TFMessage", transforms)


def encode_text(text: str) -> bytes:
    """Encode a std_msgs/String as CDR."""
    return pack("std_msgs/msg/String", text)


OK, WARN, ERROR, STALE = range(4)
"""Levels of a `HealthStatus`."""


class HealthStatus(NamedTuple):
    """How well a part of the system does."""

    level: int  # OK, WARN, ERROR or STALE
    name: str  # of the part
    text: str
    values: Mapping[str, str]  # name -> value with its unit


def encode_diagnostics(stamp_ns: int, statuses: Iterable[HealthStatus], robot: str = "") -> bytes:
    """Encode a diagnostic_msgs/DiagnosticArray as CDR; `robot` is the name of the robot."""
    found = [_fields(each, robot) for each in statuses]
    return pack("diagnostic_msgs/msg/DiagnosticArray", header(stamp_ns, ""), found)


def encode_status(status: HealthStatus, robot: str = "") -> bytes:
    """Encode a diagnostic_msgs/DiagnosticStatus as CDR; `robot` is the name of the robot."""
    return pack("diagnostic_msgs/msg/DiagnosticStatus", *_fields(status, robot))


def _fields(status: HealthStatus, robot: str) -> tuple[Any, ...]:
    return status.level, status.name, status.text, robot, status.values.items()


def decode_stamped_twist(data: bytes) -> tuple[int, str, Vector, float]:
    """Decode a geometry_msgs/TwistStamped.

    Return stamp [ns], frame, linear velocity [m/s], and angular velocity about z [rad/s].
    """
    message: Any = STORE.deserialize_cdr(data, "geometry_msgs/msg/TwistStamped")
    return stamp_of(message), message.header.frame_id, *twist_of(message.twist)


def decode_twist(data: bytes) -> tuple[Vector, float]:
    """Decode a geometry_msgs/Twist: linear velocity [m/s], angular velocity about z [rad/s]."""
    return twist_of(STORE.deserialize_cdr(data, "geometry_msgs/msg/Twist"))
