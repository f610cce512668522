# SPDX-License-Identifier: Apache-2.0

"""Convert rows of topics to ROS 2 messages in CDR encoding, and back.

ROS stores quaternions as `xyzw` and the velocity of an odometry in the body frame; cloudrc uses
`wxyz` and the world frame. Only this module converts between them. Every message begins with a
`std_msgs/Header`, which contains the row's stamp; the frames are `world`, `base_link`, `lidar` and
`camera`.

The message types in `cloudrc_msgs` are generated from `record/topics.py`, with a comment
and a unit for each field. All other types are standard ROS types. The package rosbags parses,
encodes and hashes all types.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from operator import attrgetter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from cloudrc.results.record.topics import TOPICS, Kind, Row, Topic, Values
from cloudrc.wire.messages import Quaternion, Vector
from cloudrc.wire.rotation import rotate

_OURS = "cloudrc_msgs/"
SCAN, LIDAR = "sensor_msgs/msg/LaserScan", "lidar"
"""Type of a scan, and its frame, that of the scanner."""
PICTURE, CAMERA = "sensor_msgs/msg/CompressedImage", "camera"
"""Type of a picture, and its frame, that of the camera."""
_ROS_NAMES: dict[Kind, str] = {
    "int": "int64",
    "float": "float64",
    "bool": "bool",
    "string": "string",
    "vector": "geometry_msgs/Vector3",
}
STORE = get_typestore(Stores.ROS2_JAZZY)
"""All message types that rosbags can encode: those of ROS 2 Jazzy and of cloudrc."""


def _own_definition(ros_type: str) -> str:
    topics = [topic for topic in TOPICS.values() if topic.ros_type == ros_type]
    lines = [f"# {topic.name}: {topic.text}" for topic in topics]
    lines.append("std_msgs/Header header  # stamp: instant of the row")
    for field in topics[0].fields:
        unit = f"[{field.unit}] " if field.unit else ""
        lines.append(f"{_ROS_NAMES[field.kind]} {field.name}  # {unit}{field.text}")
    return "\n".join(lines) + "\n"


_NAMES = {topic.ros_type for topic in TOPICS.values()}
_OWN = {name: _own_definition(name) for name in _NAMES if name.startswith(_OURS)}
for _name, _text in _OWN.items():
    STORE.register(get_types_from_msg(_text, _name))


@cache
def definition(ros_type: str) -> str:
    """Return a message type's definition as `ros2msg`, including the types that it uses."""
    text, _ = STORE.generate_msgdef(ros_type, ros_version=2)
    own, mark, needed = text.partition("=" * 80)
    return _OWN.get(ros_type, own) + mark + needed


@cache
def type_hash(ros_type: str) -> str:
    """Return the RIHS01 hash by which ROS 2 identifies a message type."""
    return STORE.hash_rihs01(ros_type)


def is_known(ros_type: str, text: str) -> bool:
    """Return whether `text`, a type's definition in a file, has the layout of this version."""
    if text == definition(ros_type):
        return True
    try:
        found = get_types_from_msg(text, ros_type)
    except TypesysError:
        return False
    known = {name: fields for name, (_, fields) in STORE.fielddefs.items()}
    return all(known.get(name) == fields for name, (_, fields) in found.items())


_SECOND_NS = 1_000_000_000
_ENCAPSULATION = 4
"""Size of the encapsulation header [bytes]; its second byte is 1 in little-endian messages."""

Make: TypeAlias = Callable[[Iterable[Any]], Any]


def pack(ros_type: str, *values: Any) -> bytes:
    """Encode the values of a message's fields as little-endian CDR with encapsulation header.

    The value of a field that is a message itself is a tuple with the values of its fields.
    """
    return bytes(STORE.serialize_cdr(_maker(ros_type)(values), ros_type, little_endian=True))


@cache
def _maker(ros_type: str) -> Make:
    """Return a function that makes rosbags' object of a type from the values of its fields."""
    cls: Any = STORE.types[ros_type]
    makers = [_maker_of_field(*kind) for _, kind in STORE.fielddefs[ros_type][1]]
    if not any(makers):
        return lambda values: cls(*values)
    return lambda values: cls(
        *[make(value) if make else value for make, value in zip(makers, values, strict=True)]
    )


def _maker_of_field(kind: Nodetype, detail: Any) -> Make | None:
    """Return the function for a field that is a message, or a list of messages."""
    if kind == Nodetype.NAME:
        return _maker(detail)
    if kind == Nodetype.SEQUENCE and detail[0][0] == Nodetype.NAME:
        make = _maker(detail[0][1])
        return lambda values: [make(value) for value in values]
    return None


def encode(topic: Topic, row: Row) -> bytes:
    """Encode a row as little-endian CDR with encapsulation header."""
    if pack_row := _PACKERS[topic.name]:
        return pack_row(row)
    values = [_readable(value) if isinstance(value, str) else value for value in row[1:]]
    return pack(topic.ros_type, header(row[0]), *values)


def _readable(text: str) -> str:
    """Replace what UTF-8 cannot express."""
    return text if text.isascii() else text.encode("utf-8", "replace").decode()


def header(stamp_ns: int, frame: str = "world") -> Values:
    """Return the values of a message's header from its stamp [ns] and the name of its frame."""
    return divmod(stamp_ns, _SECOND_NS), frame


def decode(topic: Topic, data: bytes) -> Row:
    """Decode CDR bytes with encapsulation header to a row."""
    message: Any = STORE.deserialize_cdr(data, topic.ros_type)
    return stamp_of(message), *_PARSE[topic.name](message)


def columns(topic: Topic, messages: Sequence[bytes]) -> list[NDArray[Any]] | None:
    """Decode messages of a topic at once: a column of stamps [ns], and one for each field.

    Return None unless all have the layout that cloudrc writes, with numbers alone.
    """
    layout = _BLOCKS[topic.name]
    if layout is None or any(len(data) != layout.itemsize for data in messages):
        return None
    rows = np.frombuffer(b"".join(messages), layout)
    if (rows["code"] != _LITTLE).any() or (rows["frame"] != _FRAME).any():
        return None
    stamps_ns = rows["sec"].astype(np.int64) * _SECOND_NS + rows["nanosec"]
    return [stamps_ns, *(rows[field.name].copy() for field in topic.fields)]


def stamp_of(message: Any) -> int:
    """Return the stamp in the header of a message [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec * _SECOND_NS + stamp.nanosec)


def twist_of(twist: Any) -> tuple[Vector, float]:
    """Return the linear velocity of a twist [m/s], and its angular velocity about z [rad/s]."""
    return _xyz(twist.linear), twist.angular.z


def shifted(data: bytes, offset_ns: int) -> bytes:
    """Add `offset_ns` [ns] to a message's stamp, without decoding the other values."""
    if offset_ns == 0:
        return data
    stamp = struct.Struct("<iI" if data[1] else ">iI")
    sec, nanosec = stamp.unpack_from(data, _ENCAPSULATION)
    moved = stamp.pack(*divmod(sec * _SECOND_NS + nanosec + offset_ns, _SECOND_NS))
    return data[:_ENCAPSULATION] + moved + data[_ENCAPSULATION + stamp.size :]


def _parse_odometry(message: Any) -> Values:
    pose, twist = message.pose.pose, message.twist.twist
    turn = pose.orientation
    wxyz = turn.w, turn.x, turn.y, turn.z
    return _xyz(pose.position), wxyz, rotate(wxyz, _xyz(twist.linear)), _xyz(twist.angular)


def _parse_scan(scan: Any) -> Values:
    shape = scan.angle_min, scan.angle_increment, scan.scan_time, scan.range_max
    return *shape, scan.ranges.tolist()


def _xyz(vector: Any) -> Vector:
    return vector.x, vector.y, vector.z


_Parse: TypeAlias = Callable[[Any], Values]
_PARSERS: dict[str, _Parse] = {
    "nav_msgs/msg/Odometry": _parse_odometry,
    "geometry_msgs/msg/TwistStamped": lambda message: twist_of(message.twist),
    "geometry_msgs/msg/PointStamped": lambda message: (_xyz(message.point),),
    SCAN: _parse_scan,
    PICTURE: lambda picture: (picture.format, picture.data.tobytes()),
}
"""Standard ROS type -> function to decode it; a topic may use only its first fields."""


def _parser(topic: Topic) -> _Parse:
    """Return a function that takes a row's values from a message."""
    if parse_all := _PARSERS.get(topic.ros_type):
        count = len(topic.fields)
        return lambda message: parse_all(message)[:count]
    read = [(attrgetter(field.name), field.kind == "vector") for field in topic.fields]
    return lambda message: tuple(
        [_xyz(get(message)) if is_vector else get(message) for get, is_vector in read]
    )


_HEAD = "<4siII6s"
"""Encapsulation, and the header with the frame "world", in the notation of `struct`."""
_CODES: dict[Kind, str] = {"int": "q", "float": "d", "bool": "?", "vector": "ddd"}
"""Kind of a value in a message without texts -> its numbers in the notation of `struct`."""
_NO_RATES = (np.nan, np.nan, np.nan)
_FIXED: dict[str, tuple[str, Callable[[Values], Any]]] = {
    "nav_msgs/msg/Odometry": (
        f"{_HEAD}2xI10s6x7d288x6d288x",
        lambda values: _odometry_numbers(*values),
    ),
    "geometry_msgs/msg/TwistStamped": (
        f"{_HEAD}6x6d",
        lambda values: (*values[0], 0.0, 0.0, values[1] if len(values) > 1 else 0.0),
    ),
    "geometry_msgs/msg/PointStamped": (f"{_HEAD}6x3d", lambda values: values[0]),
}
"""Standard ROS type -> layout of its messages, and function that lists their numbers."""


def _odometry_numbers(
    position: Vector, wxyz: Quaternion, velocity: Vector, rates: Vector = _NO_RATES
) -> Values:
    w, x, y, z = wxyz
    twist = *rotate((w, -x, -y, -z), velocity), *rates
    return len("base_link") + 1, b"base_link", *position, x, y, z, w, *twist


def _packer(topic: Topic) -> Callable[[Row], bytes] | None:
    """Return a function that encodes a row; None if the topic has texts, whose size is not fixed.

    rosbags would need ten times as long, for 40,000 messages of a flight of half a minute.
    """
    kinds = [field.kind for field in topic.fields]
    if topic.ros_type == SCAN:
        return pack_scan
    if topic.ros_type == PICTURE:
        return pack_picture
    if "string" in kinds:
        return None
    layout, numbers = _FIXED.get(topic.ros_type) or (_layout(kinds), partial(_numbers, kinds))
    pack = struct.Struct(layout).pack
    return lambda row: pack(
        b"\0\1\0\0", *divmod(row[0], _SECOND_NS), 6, b"world", *numbers(row[1:])
    )


def pack_scan(row: Row, frame: str = LIDAR) -> bytes:
    """Encode a row of /scan as a sensor_msgs/LaserScan whose scanner has this frame."""
    stamp_ns, angle_min, step, period, range_max, ranges = row
    angles = angle_min, angle_min + step * (len(ranges) - 1), step
    arrays = np.float32(ranges), np.empty(0, np.float32)  # intensities: none
    return pack(SCAN, header(stamp_ns, frame), *angles, 0.0, period, 0.0, range_max, *arrays)


def pack_picture(row: Row, frame: str = CAMERA) -> bytes:
    """Encode a row of /camera as a sensor_msgs/CompressedImage whose camera has this frame."""
    stamp_ns, form, data = row
    return pack(PICTURE, header(stamp_ns, frame), form, np.frombuffer(data, np.uint8))


def _layout(kinds: Iterable[Kind]) -> str:
    """Return the layout of a message of cloudrc: CDR aligns each number to its size."""
    layout, offset = _HEAD, struct.calcsize(_HEAD) - _ENCAPSULATION
    for code in "".join(_CODES[kind] for kind in kinds):
        size = struct.calcsize(f"<{code}")
        gap = -offset % size
        layout += f"{gap}x{code}"
        offset += gap + size
    return layout


_LITTLE, _FRAME = b"\0\1", b"\6\0\0\0world"
"""Begin of a little-endian message, and the frame in its header, without their final zeros."""
_FORMS: dict[Kind, Any] = {"int": "<i8", "float": "<f8", "bool": "?", "vector": ("<f8", 3)}
"""Kind of a value in a message without texts -> its type in numpy."""


def _block(topic: Topic) -> np.dtype[Any] | None:
    """Return the layout of a topic's messages as numpy has it; None if they have texts."""
    kinds = [field.kind for field in topic.fields]
    if not topic.ros_type.startswith(_OURS) or not {*kinds} <= _FORMS.keys():
        return None
    parts = [("code", "S4", 0), ("sec", "<i4", 4), ("nanosec", "<u4", 8), ("frame", "S10", 12)]
    for count, field in enumerate(topic.fields, start=1):
        end, size = (
            struct.calcsize(each) for each in (_layout(kinds[:count]), f"<{_CODES[field.kind]}")
        )
        parts.append((field.name, _FORMS[field.kind], end - size))
    names, formats, offsets = zip(*parts, strict=True)
    whole: dict[str, Any] = {"names": names, "formats": formats, "offsets": offsets}
    whole["itemsize"] = struct.calcsize(_layout(kinds))
    layout: np.dtype[Any] = np.dtype(whole)  # type: ignore[call-overload]
    return layout


def _numbers(kinds: Iterable[Kind], values: Values) -> list[Any]:
    """List the numbers of a row's values, those of a vector one by one."""
    found: list[Any] = []
    for kind, value in zip(kinds, values, strict=True):
        if kind == "vector":
            found += value
        else:
            found.append(value)
    return found


_PACKERS = {name: _packer(topic) for name, topic in TOPICS.items()}
_PARSE = {name: _parser(topic) for name, topic in TOPICS.items()}
_BLOCKS = {name: _block(topic) for name, topic in TOPICS.items()}

# What the writing thread needs is made on import: rosbags takes milliseconds for each type, and in
# flight the thread would block the loop for that time.
for _name in _NAMES:
    definition(_name), type_hash(_name)
for _name, _pack in _PACKERS.items():
    if not _pack:
        STORE.get_msgdef(TOPICS[_name].ros_type)
