# SPDX-License-Identifier: Apache-2.0

"""Encode messages as datagrams and decode them, with a fixed little-endian layout per kind.

docs/wire.md describes the layout. `session` encrypts the bodies and makes the tags. The functions
raise no exception except DecodeError.

Deviation: the paper's tunnel sends pickled ROS messages, which have 1 kB and can execute code.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, TypeAlias

from cloudrc.wire.messages import (
    FRAGMENT_MAX,
    NEVER_NS,
    RAYS_MAX,
    SENSORS_MAX,
    TOUCH_NAME_MAX,
    Cause,
    Command,
    Datagram,
    Fragment,
    GuardState,
    Odometry,
    OperatorRequest,
    Passed,
    RangeScan,
    Request,
    Start,
    Telemetry,
    Vector,
)

VERSION = 8  # of the wire format; a release of cloudrc refuses all other versions
PLAN_MAX = 80  # largest number of velocities in a command's plan
DATAGRAM_MAX = 1200  # size of the receive buffer; valid datagrams fit into one packet [bytes]
NUMBER_MAX = 2**32 - 1  # highest number of an operator request


class Kind(IntEnum):
    """Kind of a datagram's content. Each kind has its own counter in each direction.

    Kinds up to LAST_HANDSHAKE belong to the handshake and are authenticated with the pre-shared
    key. The other kinds belong to a session and are encrypted with the session's keys.
    """

    HELLO = 1
    ACCEPT = 2
    CHALLENGE = 3
    BUSY = 4
    TELEMETRY = 5
    COMMAND = 6
    OPERATOR = 7
    ALIVE = 8
    SCAN = 9
    FRAME = 10


class Direction(IntEnum):
    """Direction of a datagram: the uplink is world to cloud, the downlink is cloud to world."""

    UPLINK = 0
    DOWNLINK = 1


class DecodeError(ValueError):
    """An invalid datagram; the text is the name under which the receiver counts the error."""


Header: TypeAlias = tuple[int, int, int, int, int]
"""Version, direction, epoch, kind and counter of a datagram."""


class Hello(NamedTuple):
    """Cloud's request for a session."""

    nonce: bytes  # 16 random bytes that identify the cloud process
    clock: bytes  # 16 bytes that identify cloud's monotonic clock
    cookie: bytes  # the 13 bytes of world's challenge, or zeros
    epoch: int  # newest session number that cloud knows; the new session gets a higher number


class Accept(NamedTuple):
    """World's answer that opens a session."""

    nonce: bytes  # copied from the answered hello
    world_nonce: bytes  # 16 random bytes that identify the world process
    clock: bytes  # 16 bytes that identify world's monotonic clock


COOKIE_SIZE = 13  # size of a cookie [bytes]
_HEADER = struct.Struct("<BBIxBQ")  # the pad byte is 0
_BODIES = {
    Kind.HELLO: struct.Struct("<16s16s13sI"),
    Kind.ACCEPT: struct.Struct("<16s16s16sx"),
    Kind.CHALLENGE: struct.Struct("<13s36x"),  # as long as the hello that answers it
    Kind.BUSY: struct.Struct("<16sx"),
    Kind.TELEMETRY: struct.Struct("<q3d4d3d3dqqqIdIQHBB"),
    Kind.COMMAND: struct.Struct("<qqq3dd"),
    Kind.OPERATOR: struct.Struct("<IBBQHq"),
    Kind.ALIVE: struct.Struct(""),
    Kind.SCAN: struct.Struct("<q"),
    Kind.FRAME: struct.Struct("<qIHHB"),
}
_TELEMETRY, _COMMAND = _BODIES[Kind.TELEMETRY], _BODIES[Kind.COMMAND]
_OPERATOR, _SCAN, _FRAME = _BODIES[Kind.OPERATOR], _BODIES[Kind.SCAN], _BODIES[Kind.FRAME]
BODY_SIZES = {kind: body.size for kind, body in _BODIES.items()}
LAST_HANDSHAKE = int(Kind.BUSY)
HEADER_SIZE, TAG_SIZE = _HEADER.size, 16
SIZES = {int(kind): HEADER_SIZE + size + TAG_SIZE for kind, size in BODY_SIZES.items()}

_GUARD_STATES, _CAUSES = tuple(GuardState), tuple(Cause)
_new = tuple.__new__  # makes a named tuple four times as fast as its class does
_PLANNED, _VELOCITY = struct.Struct("<q"), struct.Struct("<3f")
_SENSORS = tuple(struct.Struct(f"<{n}d") for n in range(SENSORS_MAX + 1))
COMMAND_SIZES = tuple(
    SIZES[Kind.COMMAND] + (_PLANNED.size + n * _VELOCITY.size if n else 0)
    for n in range(PLAN_MAX + 1)
)
"""Number of velocities in a command's plan -> size of the datagram [bytes]."""
TELEMETRY_SIZES = tuple(SIZES[Kind.TELEMETRY] + each.size for each in _SENSORS)
"""Number of the robot's own sensors -> size of a datagram of telemetry [bytes]."""
SCAN_SIZES = tuple(SIZES[Kind.SCAN] + 2 * n for n in range(RAYS_MAX + 1))
"""Number of rays -> size of a datagram with their distances [bytes]."""
_sizes_of: dict[int, Container[int]] = {
    **{kind: (size,) for kind, size in SIZES.items()},
    int(Kind.TELEMETRY): frozenset(TELEMETRY_SIZES),
    int(Kind.COMMAND): frozenset(COMMAND_SIZES),
    int(Kind.SCAN): frozenset(SCAN_SIZES),
    int(Kind.FRAME): range(SIZES[Kind.FRAME] + 1, SIZES[Kind.FRAME] + FRAGMENT_MAX + 1),
    int(Kind.OPERATOR): range(SIZES[Kind.OPERATOR], SIZES[Kind.OPERATOR] + TOUCH_NAME_MAX + 1),
}
"""Kind -> valid sizes of its datagrams [bytes]."""
_unpack_header: Callable[[bytes], Header] = _HEADER.unpack_from


def encode_header(kind: int, direction: int, epoch: int, counter: int) -> bytes:
    """Encode the header; epoch < 2^32, counter < 2^64."""
    return _HEADER.pack(VERSION, direction, epoch, kind, counter)


def check(data: bytes) -> Header:
    """Decode the header of a datagram, before the datagram is authenticated.

    Raise the DecodeError "version", or "malformed" for an invalid direction, kind or length.
    """
    size = len(data)
    if size < HEADER_SIZE:
        raise DecodeError("malformed")
    header = _unpack_header(data)
    if header[0] != VERSION:
        raise DecodeError("version")
    if header[1] > 1:
        raise DecodeError("malformed")
    if size not in _sizes_of.get(header[3], ()):
        raise DecodeError("malformed")
    return header


def peek(data: Datagram) -> tuple[int, int, int]:
    """Read kind, epoch and counter of a datagram without any check, for the link and for logs.

    Raise the DecodeError "malformed" if the datagram is shorter than a header.
    """
    if isinstance(data, Passed):
        return data[:3]
    if len(data) < HEADER_SIZE:
        raise DecodeError("malformed")
    _, _, epoch, kind, counter = _unpack_header(data)
    return kind, epoch, counter


# Naming every number takes half the time of slicing and unpacking.


def encode_telemetry(telemetry: Telemetry) -> bytes:
    """Encode the body of a TELEMETRY datagram."""
    # fmt: off
    (
        stamp_ns, odometry, sensors, echo_ns, hold_ns, slip_ns, mission, guard, obstacles, touch,
        mission_id, reached, cause,
    ) = telemetry
    _, (px, py, pz), (qw, qx, qy, qz), (vx, vy, vz), (rx, ry, rz) = odometry
    return _TELEMETRY.pack(
        stamp_ns, px, py, pz, qw, qx, qy, qz, vx, vy, vz, rx, ry, rz, echo_ns, hold_ns, slip_ns,
        mission, touch, obstacles, mission_id, reached, guard, cause,
    ) + _SENSORS[len(sensors)].pack(*sensors)
    # fmt: on


def decode_telemetry(body: bytes) -> Telemetry:
    """Decode the body of a TELEMETRY datagram; its floats may have any value, even NaN."""
    # fmt: off
    (
        stamp_ns, px, py, pz, qw, qx, qy, qz, vx, vy, vz, rx, ry, rz, echo_ns, hold_ns, slip_ns,
        mission, touch, obstacles, mission_id, reached, guard, cause,
    ) = _TELEMETRY.unpack_from(body)
    sensors = _SENSORS[(len(body) - _TELEMETRY.size) // 8].unpack_from(body, _TELEMETRY.size)
    if guard >= len(_GUARD_STATES) or cause >= len(_CAUSES):
        raise DecodeError("malformed")
    odometry = _new(
        Odometry, (stamp_ns, (px, py, pz), (qw, qx, qy, qz), (vx, vy, vz), (rx, ry, rz))
    )
    return _new(Telemetry, (
        stamp_ns, odometry, sensors, echo_ns, hold_ns, slip_ns, mission, _GUARD_STATES[guard],
        obstacles, touch, mission_id, reached, _CAUSES[cause],
    ))
    # fmt: on


def encode_command(command: Command) -> bytes:
    """Encode the body of a COMMAND datagram."""
    stamp_ns, basis_stamp_ns, basis_hold_ns, (x, y, z), yaw_rate, plan, planned_ns = command
    body = _COMMAND.pack(stamp_ns, basis_stamp_ns, basis_hold_ns, x, y, z, yaw_rate)
    if not plan:
        return body
    return body + _PLANNED.pack(planned_ns) + b"".join([_VELOCITY.pack(*each) for each in plan])


def as_planned(numbers: Sequence[float]) -> list[Vector]:
    """Round velocities [m/s] to single precision, as a plan in a datagram has them.

    `numbers` are three of each velocity, one after the other.
    """
    return list(_VELOCITY.iter_unpack(struct.pack(f"<{len(numbers)}f", *numbers)))


def decode_command(body: bytes) -> Command:
    """Decode the body of a COMMAND datagram; its floats may have any value, even NaN."""
    stamp_ns, basis_stamp_ns, basis_hold_ns, x, y, z, yaw_rate = _COMMAND.unpack_from(body)
    plan: tuple[Vector, ...] = ()
    planned_ns, size = NEVER_NS, _COMMAND.size
    if len(body) > size:
        (planned_ns,) = _PLANNED.unpack_from(body, size)
        plan = tuple(_VELOCITY.iter_unpack(body[size + _PLANNED.size :]))
    fields = (stamp_ns, basis_stamp_ns, basis_hold_ns, (x, y, z), yaw_rate, plan, planned_ns)
    return _new(Command, fields)


def encode_scan(scan: RangeScan) -> bytes:
    """Encode the body of a SCAN datagram."""
    stamp_ns, millimetres = scan
    return struct.pack(f"<q{len(millimetres)}H", stamp_ns, *millimetres)


def decode_scan(body: bytes) -> RangeScan:
    """Decode the body of a SCAN datagram."""
    stamp_ns, *millimetres = struct.unpack(f"<q{(len(body) - _SCAN.size) // 2}H", body)
    return RangeScan(stamp_ns, tuple(millimetres))


def encode_fragment(fragment: Fragment) -> bytes:
    """Encode the body of a FRAME datagram."""
    *fields, data = fragment
    return _FRAME.pack(*fields) + data


def decode_fragment(body: bytes) -> Fragment:
    """Decode the body of a FRAME datagram."""
    stamp_ns, number, place, count, key = _FRAME.unpack_from(body)
    if place >= count or key > 1:
        raise DecodeError("malformed")
    return Fragment(stamp_ns, number, place, count, bool(key), body[_FRAME.size :])


def encode_operator(request: OperatorRequest) -> bytes:
    """Encode the body of an OPERATOR datagram; the header has the request's epoch."""
    number, kind, start, mission_id, reached, basis_stamp_ns, _, touch = request
    body = _OPERATOR.pack(number, kind, start, mission_id, reached, basis_stamp_ns)
    return body + touch.encode()


def decode_operator(body: bytes) -> OperatorRequest:
    """Decode the body of an OPERATOR datagram."""
    number, kind, start, mission_id, reached, basis_stamp_ns = _OPERATOR.unpack_from(body)
    # A recording holds signed 64-bit integers.
    if mission_id >> 63 or kind >= len(Request) or start >= len(Start):
        raise DecodeError("malformed")
    try:
        touch = body[_OPERATOR.size :].decode()
    except UnicodeDecodeError:
        raise DecodeError("malformed") from None
    fields = number, Request(kind), Start(start), mission_id, reached, basis_stamp_ns
    return OperatorRequest(*fields, touch=touch)


def encode(kind: Kind, *fields: Any) -> bytes:
    """Encode the body of a handshake datagram: the fields of a `Hello` or `Accept`.

    A CHALLENGE has only a cookie. A BUSY has only the nonce of the hello that it answers.
    """
    return _BODIES[kind].pack(*fields)


def decode(kind: Kind, body: bytes) -> tuple[Any, ...]:
    """Decode the body of a handshake datagram; return its fields, such as nonce or cookie."""
    return _BODIES[kind].unpack(body)
