"""Convert rows of topics to ROS 2 messages in CDR and back.

Only this module converts quaternions from `wxyz` to `xyzw`, and an odometry's velocity from the
world frame to the body frame. Every message begins with a `std_msgs/Header` that has the row's
stamp; the frames are `world` and `base_link`.

The message types in `cloudrc_msgs` are generated from `cloudrc/record/topics.py`, with a comment
and a unit for each field; the other types are standard ROS types. rosbags parses, encodes and
hashes all types.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from cloudrc.messages import Quaternion, Vector
from cloudrc.record import missing
from cloudrc.record.topics import TOPICS, Kind, Topic, Values

try:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError as error:
    raise missing(error) from error

_OURS = "cloudrc_msgs/"
_ROS_NAMES: dict[Kind, str] = {
    "int": "int64",
    "float": "float64",
    "bool": "bool",
    "string": "string",
    "vector": "geometry_msgs/Vector3",
    "quaternion": "geometry_msgs/Quaternion",
}


def _own_definition(ros_type: str) -> str:
    topics = [topic for topic in TOPICS.values() if topic.ros_type == ros_type]
    lines = [f"# {topic.name}: {topic.text}" for topic in topics]
    lines.append("std_msgs/Header header  # stamp: instant of the row")
    for field in topics[0].fields:
        unit = f"[{field.unit}] " if field.unit else ""
        lines.append(f"{_ROS_NAMES[field.kind]} {field.name}  # {unit}{field.text}")
    return "\n".join(lines) + "\n"


_OWN = {t.ros_type: _own_definition(t.ros_type) for t in TOPICS.values() if _OURS in t.ros_type}

TEXT_MAX = 1 << 16
"""Longest definition that is parsed [characters]; those of cloudrc and ROS have a few thousand."""
STORE = get_typestore(Stores.ROS2_JAZZY)
"""The message types of rosbags, including those of cloudrc."""
for _name, _text in _OWN.items():
    STORE.register(get_types_from_msg(_text, _name))


def _whole_definition(ros_type: str) -> str:
    text, _ = STORE.generate_msgdef(ros_type, ros_version=2)
    own, mark, needed = text.partition("=" * 80)
    return _OWN.get(ros_type, own) + mark + needed


# All types are generated on import: rosbags takes milliseconds for each, and in flight the writing
# thread would block the loop for that time.
_NAMES = {topic.ros_type for topic in TOPICS.values()}
_DEFINITIONS = {name: _whole_definition(name) for name in _NAMES}
_HASHES = {name: STORE.hash_rihs01(name) for name in _NAMES}
for _name in _NAMES:
    STORE.get_msgdef(_name)


def definition(ros_type: str) -> str:
    """Return a message type's definition in the encoding `ros2msg`.

    Args:
        ros_type: Type of a topic.

    Returns:
        The definition of the type and of the types that it uses. Types of cloudrc have a comment
        and a unit for each field.
    """
    return _DEFINITIONS[ros_type]


def type_hash(ros_type: str) -> str:
    """Return the RIHS01 hash by which ROS 2 identifies a message type.

    Args:
        ros_type: Type of a topic.
    """
    return _HASHES[ros_type]


@lru_cache(maxsize=256)
def is_known(ros_type: str, text: str) -> bool:
    """Check whether a definition from a file has the layout that `decode` expects.

    Args:
        ros_type: Name of the message type.
        text: Definition of the type in the encoding `ros2msg`; comments are ignored.
    """
    if text == definition(ros_type):
        return True
    if len(text) > TEXT_MAX:  # its parser is slow
        return False
    try:
        found = get_types_from_msg(text, ros_type)
    except Exception:  # rosbags' parser may raise anything on a foreign text
        return False
    known = STORE.fielddefs
    return all(name in known and known[name][1] == found[name][1] for name in found)


_SECOND_NS = 1_000_000_000
_ENCAPSULATION = 4
"""Size of the encapsulation header before the message [bytes]; its second byte is 1 if the message
is little-endian."""

_type: dict[str, Any] = dict(STORE.types)
_Time, _Header = _type["builtin_interfaces/msg/Time"], _type["std_msgs/msg/Header"]
_Vector3, _Point = _type["geometry_msgs/msg/Vector3"], _type["geometry_msgs/msg/Point"]
_Quaternion, _Pose = _type["geometry_msgs/msg/Quaternion"], _type["geometry_msgs/msg/Pose"]
_PoseWithCovariance = _type["geometry_msgs/msg/PoseWithCovariance"]
_Twist, _TwistStamped = _type["geometry_msgs/msg/Twist"], _type["geometry_msgs/msg/TwistStamped"]
_TwistWithCovariance = _type["geometry_msgs/msg/TwistWithCovariance"]
_Odometry = _type["nav_msgs/msg/Odometry"]
_PointStamped = _type["geometry_msgs/msg/PointStamped"]

_NO_COVARIANCE = np.zeros(36)
_UNKNOWN = _Vector3(np.nan, np.nan, np.nan)


def encode(topic: Topic, stamp_ns: int, values: Values) -> bytes:
    """Encode a row as the CDR bytes of its ROS message.

    Args:
        topic: Topic of the row.
        stamp_ns: Stamp of the row, which becomes the header's stamp [ns].
        values: Values in the order of the topic's fields.

    Returns:
        Little-endian CDR bytes with their encapsulation header.
    """
    sec, nanosec = divmod(stamp_ns, _SECOND_NS)
    build = _CODECS[topic.name][0]
    message = build(_Header(_Time(sec, nanosec), "world"), values)
    return bytes(STORE.serialize_cdr(message, topic.ros_type, little_endian=True))


def decode(topic: Topic, data: bytes) -> tuple[int, Values]:
    """Decode the CDR bytes of a ROS message to a row.

    Args:
        topic: Topic of the message.
        data: CDR bytes with their encapsulation header.

    Returns:
        The stamp [ns] and the values in the order of the topic's fields.
    """
    message: Any = STORE.deserialize_cdr(data, topic.ros_type)
    stamp = message.header.stamp
    return stamp.sec * _SECOND_NS + stamp.nanosec, _CODECS[topic.name][1](message)


def shifted(data: bytes, offset_ns: int) -> bytes:
    """Shift a message's stamp without decoding the rest of the message.

    Args:
        data: CDR bytes of a message of cloudrc; all these begin with the stamp of their header.
        offset_ns: Added to the stamp [ns].
    """
    if offset_ns == 0:
        return data
    stamp = struct.Struct("<iI" if data[1] else ">iI")
    sec, nanosec = stamp.unpack_from(data, _ENCAPSULATION)
    moved = stamp.pack(*divmod(sec * _SECOND_NS + nanosec + offset_ns, _SECOND_NS))
    return data[:_ENCAPSULATION] + moved + data[_ENCAPSULATION + stamp.size :]


def _rotate(orientation_wxyz: Quaternion, vector: Vector) -> Vector:
    """Rotate a vector from the body frame to the world frame: v + 2 · u x (u x v + w · v).

    This is Rodrigues' formula for the unit quaternion (w, u).
    """
    w, x, y, z = orientation_wxyz
    a, b, c = vector
    p, q, r = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return a + 2 * (y * r - z * q), b + 2 * (z * p - x * r), c + 2 * (x * q - y * p)


def _build_odometry(header: Any, values: Values) -> Any:
    position, (w, x, y, z), velocity = values[:3]
    rates = _Vector3(*values[3]) if len(values) > 3 else _UNKNOWN
    pose = _Pose(_Point(*position), _Quaternion(x, y, z, w))
    twist = _Twist(_Vector3(*_rotate((w, -x, -y, -z), velocity)), rates)
    with_pose = _PoseWithCovariance(pose, _NO_COVARIANCE)
    return _Odometry(header, "base_link", with_pose, _TwistWithCovariance(twist, _NO_COVARIANCE))


def _parse_odometry(message: Any) -> Values:
    pose, twist = message.pose.pose, message.twist.twist
    q = pose.orientation
    wxyz = (q.w, q.x, q.y, q.z)
    return _xyz(pose.position), wxyz, _rotate(wxyz, _xyz(twist.linear)), _xyz(twist.angular)


def _parse_odometry_without_rates(message: Any) -> Values:
    return _parse_odometry(message)[:3]


def _build_twist(header: Any, values: Values) -> Any:
    yaw_rate = values[1] if len(values) > 1 else 0.0
    return _TwistStamped(header, _Twist(_Vector3(*values[0]), _Vector3(0.0, 0.0, yaw_rate)))


def _parse_twist(message: Any) -> Values:
    return (_xyz(message.twist.linear),)


def _parse_twist_with_yaw_rate(message: Any) -> Values:
    return _xyz(message.twist.linear), message.twist.angular.z


def _build_point(header: Any, values: Values) -> Any:
    return _PointStamped(header, _Point(*values[0]))


def _parse_point(message: Any) -> Values:
    return (_xyz(message.point),)


def _xyz(vector: Any) -> Vector:
    return vector.x, vector.y, vector.z


def _printable(text: str) -> str:
    return text if text.isascii() else text.encode("utf-8", "replace").decode()


_TO_ROS: dict[Kind, Callable[[Any], Any]] = {
    "int": int,
    "float": float,
    "bool": bool,
    "string": _printable,
    "vector": lambda vector: _Vector3(*vector),
    "quaternion": lambda q: _Quaternion(q[1], q[2], q[3], q[0]),
}
_FROM_ROS: dict[Kind, Callable[[Any], Any]] = {
    "vector": _xyz,
    "quaternion": lambda q: (q.w, q.x, q.y, q.z),
}
_Codec: TypeAlias = tuple[Callable[[Any, Values], Any], Callable[[Any], Values]]


def _own_codec(topic: Topic) -> _Codec:
    cls = _type[topic.ros_type]
    to_ros = [_TO_ROS[field.kind] for field in topic.fields]
    from_ros = [(field.name, _FROM_ROS.get(field.kind)) for field in topic.fields]

    def build(header: Any, values: Values) -> Any:
        return cls(header, *[turn(value) for turn, value in zip(to_ros, values, strict=True)])

    def parse(message: Any) -> Values:
        raw = [(getattr(message, name), turn) for name, turn in from_ros]
        return tuple([turn(value) if turn else value for value, turn in raw])

    return build, parse


def _codec(topic: Topic) -> _Codec:
    several = len(topic.fields)
    match topic.ros_type:
        case "nav_msgs/msg/Odometry":
            parse = _parse_odometry if several == 4 else _parse_odometry_without_rates
            return _build_odometry, parse
        case "geometry_msgs/msg/TwistStamped":
            return _build_twist, _parse_twist if several == 1 else _parse_twist_with_yaw_rate
        case "geometry_msgs/msg/PointStamped":
            return _build_point, _parse_point
        case _:
            return _own_codec(topic)


_CODECS: dict[str, _Codec] = {name: _codec(topic) for name, topic in TOPICS.items()}
