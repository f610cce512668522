"""Messages to bytes and back: a fixed layout per kind, little-endian, nothing executable.

A datagram is a 16-byte header (version, direction, epoch, generation, kind, counter), a body of
exactly the length that its kind has, and a 16-byte tag. Here is only the layout: `session` seals
and opens. Whatever does not fit raises DecodeError, which names the outcome that it is counted
under; no other exception leaves `check` or the decoders.

The header is in the clear, since a link decides by it, and authenticated. Its last 12 bytes are the
nonce of the seal: no two datagrams of one direction of an epoch have the same kind and counter.

Deviation: the paper's tunnel sends pickled ROS messages, which execute code and weigh 1 kB.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from cloudrc.messages import (
    Cause,
    Command,
    GuardState,
    Odometry,
    OperatorRequest,
    Request,
    Start,
    Telemetry,
)

VERSION = 5
"""Of the wire, one per build; another is refused, never spoken. 1 had no tags, 2 not what a request
is based on, 3 not why the guard is in its state; in 4 a challenge was shorter than its answer."""
DATAGRAM_MAX = 512
"""Longer than any datagram of ours [bytes]; a longer one is refused unread."""


class Kind(IntEnum):
    """What a datagram carries; each kind of each direction counts its datagrams on its own.

    Up to LAST_GREETING they make a session and are authenticated by the pre-shared key; the others
    belong to one and are sealed with its keys.
    """

    HELLO = 1
    ACCEPT = 2
    CHALLENGE = 3
    BUSY = 4
    TELEMETRY = 5
    COMMAND = 6
    OPERATOR = 7
    ALIVE = 8


class Direction(IntEnum):
    """Which way a datagram goes."""

    UPLINK = 0
    DOWNLINK = 1


class DecodeError(ValueError):
    """Bytes that are not one of our datagrams; the text is the outcome that is counted."""


Header: TypeAlias = tuple[int, int, int, int, int, int]
"""Version, direction, epoch, generation of the keys, kind and counter."""
Datagram: TypeAlias = tuple[int, int, int, int, bytes]
"""Kind, direction, epoch and counter, which are in the clear in its header, and its body."""


class Hello(NamedTuple):
    """Cloud asks for a session.

    Attributes:
        nonce: 16 bytes that name the session asked for.
        clock: 16 bytes that name cloud's monotonic clock.
        cookie: From world's challenge; zeros at first.
        suite: Cipher that cloud would like.
    """

    nonce: bytes
    clock: bytes
    cookie: bytes
    suite: int


class Accept(NamedTuple):
    """World opens a session, under the epoch in the header.

    Attributes:
        nonce: Of the hello answered.
        world_nonce: 16 bytes that name world's process.
        clock: 16 bytes that name world's monotonic clock.
        suite: Cipher of the session.
    """

    nonce: bytes
    world_nonce: bytes
    clock: bytes
    suite: int


class Busy(NamedTuple):
    """World refuses one, and says why.

    Attributes:
        nonce: Of the hello answered.
        used: Whether this nonce has had its session; else another cloud has authority.
    """

    nonce: bytes
    used: bool


_HEADER = struct.Struct("<BBIBBQ")
_TELEMETRY = struct.Struct("<q3d4d3d3ddqqqIdIQHBB")
_STAMPS = struct.Struct(f"<q{struct.calcsize('<3d4d3d3ddqq')}xq")
_COMMAND = struct.Struct("<qqq3dd")
_OPERATOR = struct.Struct("<IBBQHq")
_HELLO = struct.Struct("<16s16s16sB")
_ACCEPT = struct.Struct("<16s16s16sB")
_CHALLENGE = struct.Struct("<16s33x")  # as long as a hello, which answers it
_BUSY = struct.Struct("<16s?")

NUMBER_MAX = 2**32 - 1
"""The highest number that a request can have."""

_new = tuple.__new__  # of a named tuple: four times as fast as calling it
_unpack_header: Callable[[bytes], Header] = _HEADER.unpack_from
HEADER_SIZE = _HEADER.size
BODY_SIZES = {
    Kind.HELLO: _HELLO.size,
    Kind.ACCEPT: _ACCEPT.size,
    Kind.CHALLENGE: _CHALLENGE.size,
    Kind.BUSY: _BUSY.size,
    Kind.TELEMETRY: _TELEMETRY.size,
    Kind.COMMAND: _COMMAND.size,
    Kind.OPERATOR: _OPERATOR.size,
    Kind.ALIVE: 0,
}
LAST_GREETING = int(Kind.BUSY)
TAG_SIZE = 16
SIZES = {int(kind): HEADER_SIZE + size + TAG_SIZE for kind, size in BODY_SIZES.items()}
_size_of = SIZES.get


def encode_header(
    kind: int, direction: int, epoch: int, counter: int, generation: int = 0
) -> bytes:
    """Lay out the header; epoch < 2^32, generation < 2^8, counter < 2^64."""
    return _HEADER.pack(VERSION, direction, epoch, generation, kind, counter)


def check(data: bytes) -> Header:
    """Read a datagram's header, and check version, kind and the length that follows from it.

    Nothing in it is authenticated yet.

    Raises:
        DecodeError: "malformed" (too short, too long, unknown kind) or "version".
    """
    size = len(data)
    if size < HEADER_SIZE:
        raise DecodeError("malformed")
    header = _unpack_header(data)
    if header[0] != VERSION:
        raise DecodeError("version")
    if _size_of(header[4]) != size or header[1] > 1:
        raise DecodeError("malformed")
    return header


def peek(data: bytes) -> tuple[int, int, int]:
    """Read kind, epoch and counter of a datagram on its way, as a link needs them.

    Raises:
        DecodeError: "malformed" if it is too short to have them.
    """
    if len(data) < HEADER_SIZE:
        raise DecodeError("malformed")
    _, _, epoch, _, kind, counter = _unpack_header(data)
    return kind, epoch, counter


# Spelled out number by number: that takes half the time of slices and stars.


def encode_telemetry(telemetry: Telemetry) -> bytes:
    """Lay out the body of a TELEMETRY datagram; the guard's state and its cause come last."""
    # fmt: off
    (
        stamp_ns, odometry, force, echo_ns, hold_ns, slip_ns, mission, guard, pipes, touch,
        mission_id, reached, cause,
    ) = telemetry
    _, (px, py, pz), (qw, qx, qy, qz), (vx, vy, vz), (rx, ry, rz) = odometry
    return _TELEMETRY.pack(
        stamp_ns, px, py, pz, qw, qx, qy, qz, vx, vy, vz, rx, ry, rz, force, echo_ns, hold_ns,
        slip_ns, mission, touch, pipes, mission_id, reached, guard, cause,
    )
    # fmt: on


def decode_telemetry(body: bytes) -> Telemetry:
    """Read the body of a TELEMETRY datagram; numbers may be anything, NaN included."""
    # fmt: off
    (
        stamp_ns, px, py, pz, qw, qx, qy, qz, vx, vy, vz, rx, ry, rz, force, echo_ns, hold_ns,
        slip_ns, mission, touch, pipes, mission_id, reached, guard, cause,
    ) = _TELEMETRY.unpack(body)
    if guard >= len(_GUARD_STATES) or cause >= len(_CAUSES):
        raise DecodeError("malformed")
    odometry = _new(
        Odometry, (stamp_ns, (px, py, pz), (qw, qx, qy, qz), (vx, vy, vz), (rx, ry, rz))
    )
    return _new(Telemetry, (
        stamp_ns, odometry, force, echo_ns, hold_ns, slip_ns, mission, _GUARD_STATES[guard], pipes,
        touch, mission_id, reached, _CAUSES[cause],
    ))
    # fmt: on


def decode_stamps(body: bytes) -> tuple[int, int]:
    """Read only stamp and slip [ns] of a TELEMETRY datagram: enough for one that is not used."""
    stamp_ns, slip_ns = _STAMPS.unpack_from(body)
    return stamp_ns, slip_ns


def encode_command(command: Command) -> bytes:
    """Lay out the body of a COMMAND datagram."""
    stamp_ns, basis_stamp_ns, basis_hold_ns, (x, y, z), yaw_rate = command
    return _COMMAND.pack(stamp_ns, basis_stamp_ns, basis_hold_ns, x, y, z, yaw_rate)


def decode_command(body: bytes) -> Command:
    """Read the body of a COMMAND datagram; numbers may be anything, NaN included."""
    stamp_ns, basis_stamp_ns, basis_hold_ns, x, y, z, yaw_rate = _COMMAND.unpack(body)
    return _new(Command, (stamp_ns, basis_stamp_ns, basis_hold_ns, (x, y, z), yaw_rate))


def encode_operator(request: OperatorRequest) -> bytes:
    """Lay out the body of an OPERATOR datagram; the epoch stands in the header."""
    number, asked, start, mission_id, reached, basis_stamp_ns, _ = request
    return _OPERATOR.pack(number, asked, start, mission_id, reached, basis_stamp_ns)


def decode_operator(body: bytes) -> OperatorRequest:
    """Read the body of an OPERATOR datagram."""
    number, request, start, mission_id, reached, basis_stamp_ns = _OPERATOR.unpack(body)
    if mission_id >> 63:  # telemetry that names such a one is in no recording
        raise DecodeError("malformed")
    try:
        asked = Request(request), Start(start)
    except ValueError:
        raise DecodeError("malformed") from None
    return OperatorRequest(number, *asked, mission_id, reached, basis_stamp_ns)


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


def encode_challenge(cookie: bytes) -> bytes:
    """Lay out the body of a CHALLENGE datagram: a cookie of 16 bytes, and zeros."""
    return _CHALLENGE.pack(cookie)


def decode_challenge(body: bytes) -> bytes:
    """Read the cookie [16 bytes] in the body of a CHALLENGE datagram."""
    return body[:16]


def encode_busy(busy: Busy) -> bytes:
    """Lay out the body of a BUSY datagram."""
    return _BUSY.pack(*busy)


def decode_busy(body: bytes) -> Busy:
    """Read the body of a BUSY datagram."""
    return Busy(*_BUSY.unpack(body))


_GUARD_STATES, _CAUSES = tuple(GuardState), tuple(Cause)
