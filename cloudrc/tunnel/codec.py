"""Messages to bytes and back: a fixed layout per kind, little-endian, nothing executable.

A datagram is a 16-byte header (version, kind, direction, epoch, counter) and a body of exactly the
length that its kind has. Whatever does not fit raises DecodeError, which names the outcome that it
is counted under; no other exception leaves `decode` or the decoders.

Deviation: the paper's tunnel sends pickled ROS messages, which execute code and weigh 1 kB.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from cloudrc.messages import (
    Command,
    GuardState,
    Odometry,
    OperatorRequest,
    Request,
    Start,
    Telemetry,
)

VERSION = 1
DATAGRAM_MAX = 512
"""Longer than any datagram of ours [bytes]; a longer one is refused unread."""


class Kind(IntEnum):
    """What a datagram carries; each kind of each direction counts its datagrams on its own."""

    HELLO = 1
    ACCEPT = 2
    TELEMETRY = 3
    COMMAND = 4
    OPERATOR = 5


class Direction(IntEnum):
    """Which way a datagram goes."""

    UPLINK = 0
    DOWNLINK = 1


class DecodeError(ValueError):
    """Bytes that are not one of our datagrams; the text is the outcome that is counted."""


Datagram: TypeAlias = tuple[int, int, int, int, bytes]
"""Kind, direction, epoch and counter, which are in the clear in its header, and its body."""


class Hello(NamedTuple):
    """Cloud asks for a session. `nonce` names the cloud process, `clock` its monotonic clock."""

    nonce: bytes
    clock: bytes


class Accept(NamedTuple):
    """World opens one, under the epoch in the header; `nonce` is the one of the hello answered."""

    nonce: bytes
    world_nonce: bytes
    clock: bytes


_HEADER = struct.Struct("<BBBxIQ")
_TELEMETRY = struct.Struct("<q3d4d3d3ddqqqIdIB")
_STAMP = struct.Struct("<q")
_SLIP_OFFSET = struct.calcsize("<q3d4d3d3ddqq")
_COMMAND = struct.Struct("<qqq3dd")
_OPERATOR = struct.Struct("<IBB")
_HELLO = struct.Struct("<16s16s")
_ACCEPT = struct.Struct("<16s16s16s")

_unpack_header = _HEADER.unpack_from
HEADER_SIZE = _HEADER.size
BODY_SIZES = {
    Kind.HELLO: _HELLO.size,
    Kind.ACCEPT: _ACCEPT.size,
    Kind.TELEMETRY: _TELEMETRY.size,
    Kind.COMMAND: _COMMAND.size,
    Kind.OPERATOR: _OPERATOR.size,
}
_SIZES = {int(kind): HEADER_SIZE + size for kind, size in BODY_SIZES.items()}


def encode_header(kind: int, direction: int, epoch: int, counter: int) -> bytes:
    """Lay out the header; epoch < 2^32, counter < 2^64."""
    return _HEADER.pack(VERSION, kind, direction, epoch, counter)


def decode(data: bytes) -> Datagram:
    """Take a datagram apart, and check version, kind and the length that follows from it.

    Raises:
        DecodeError: "malformed" (too short, too long, unknown kind) or "version".
    """
    if len(data) < HEADER_SIZE:
        raise DecodeError("malformed")
    version, kind, direction, epoch, counter = _unpack_header(data)
    if version != VERSION:
        raise DecodeError("version")
    if _SIZES.get(kind) != len(data) or direction > 1:
        raise DecodeError("malformed")
    return kind, direction, epoch, counter, data[HEADER_SIZE:]


def peek(data: bytes) -> tuple[int, int, int]:
    """Read kind, epoch and counter of a datagram on its way, as a link needs them.

    Raises:
        DecodeError: "malformed" if it is too short to have them.
    """
    if len(data) < HEADER_SIZE:
        raise DecodeError("malformed")
    _, kind, _, epoch, counter = _unpack_header(data)
    return kind, epoch, counter


def encode_telemetry(telemetry: Telemetry) -> bytes:
    """Lay out the body of a TELEMETRY datagram; the guard's state comes last."""
    stamp_ns, odometry, force, echo_ns, hold_ns, slip_ns, mission, guard, pipes, touch = telemetry
    _, position, orientation, velocity, rate = odometry
    numbers = (*position, *orientation, *velocity, *rate, force, echo_ns, hold_ns, slip_ns)
    return _TELEMETRY.pack(stamp_ns, *numbers, mission, touch, pipes, guard)


def decode_telemetry(body: bytes) -> Telemetry:
    """Read the body of a TELEMETRY datagram; numbers may be anything, NaN included."""
    values = _TELEMETRY.unpack(body)
    stamp_ns, (force, echo_ns, hold_ns, slip_ns) = values[0], values[14:18]
    mission, touch, pipes, guard = values[18:]
    if guard >= len(_GUARD_STATES):
        raise DecodeError("malformed")
    odometry = Odometry(stamp_ns, values[1:4], values[4:8], values[8:11], values[11:14])
    state = _GUARD_STATES[guard]
    return Telemetry(
        stamp_ns, odometry, force, echo_ns, hold_ns, slip_ns, mission, state, pipes, touch
    )


def decode_stamps(body: bytes) -> tuple[int, int]:
    """Read only stamp and slip [ns] of a TELEMETRY datagram: enough for one that is not used."""
    (stamp_ns,) = _STAMP.unpack_from(body)
    (slip_ns,) = _STAMP.unpack_from(body, _SLIP_OFFSET)
    return stamp_ns, slip_ns


def encode_command(command: Command) -> bytes:
    """Lay out the body of a COMMAND datagram."""
    stamp_ns, basis_stamp_ns, basis_hold_ns, (x, y, z), yaw_rate = command
    return _COMMAND.pack(stamp_ns, basis_stamp_ns, basis_hold_ns, x, y, z, yaw_rate)


def decode_command(body: bytes) -> Command:
    """Read the body of a COMMAND datagram; numbers may be anything, NaN included."""
    stamp_ns, basis_stamp_ns, basis_hold_ns, x, y, z, yaw_rate = _COMMAND.unpack(body)
    return Command(stamp_ns, basis_stamp_ns, basis_hold_ns, (x, y, z), yaw_rate)


def encode_operator(request: OperatorRequest) -> bytes:
    """Lay out the body of an OPERATOR datagram."""
    return _OPERATOR.pack(request.number, request.request, request.start)


def decode_operator(body: bytes) -> OperatorRequest:
    """Read the body of an OPERATOR datagram."""
    number, request, start = _OPERATOR.unpack(body)
    try:
        return OperatorRequest(number, Request(request), Start(start))
    except ValueError:
        raise DecodeError("malformed") from None


def encode_hello(hello: Hello) -> bytes:
    """Lay out the body of a HELLO datagram."""
    return _HELLO.pack(*hello)


def decode_hello(body: bytes) -> Hello:
    """Read the body of a HELLO datagram."""
    return Hello(*_HELLO.unpack(body))


def encode_accept(accept: Accept) -> bytes:
    """Lay out the body of an ACCEPT datagram."""
    return _ACCEPT.pack(*accept)


def decode_accept(body: bytes) -> Accept:
    """Read the body of an ACCEPT datagram."""
    return Accept(*_ACCEPT.unpack(body))


_GUARD_STATES = tuple(GuardState)
