"""Teleop's datagrams: messages between cloud's and teleop's process become JSON and come back.

One message each: the name of its type, then its fields in order. Both processes are of one image
and one pod; what arrives is checked all the same, since a file that both can write to is no proof
of who wrote.
"""

from __future__ import annotations

import json
from typing import Any, TypeAlias

from pydantic import TypeAdapter, ValidationError

from cloudrc.cloud.teleop.messages import Output, Seen
from cloudrc.messages import MISSION_OVER, OperatorRequest, Request, Setpoint
from cloudrc.records import MissionEvent

Message: TypeAlias = Seen | Output
"""What goes through the sockets: `Seen` to teleop, the others to cloud."""

ALARM = OperatorRequest(0, Request.ESTOP)
"""An emergency stop that passes teleop's own machine by; cloud gives it its number."""

_LEAST, _MOST = -(2**63), 2**63 - 1
_KINDS: dict[str, TypeAdapter[Any]] = {
    kind.__name__: TypeAdapter(kind) for kind in (Seen, Setpoint, OperatorRequest, MissionEvent)
}


def encode(message: Message) -> bytes:
    """Write a message as one datagram."""
    return json.dumps([type(message).__name__, message]).encode()


def decode(data: bytes) -> Message:
    """Read a message from its datagram.

    Raises:
        ValueError: If it is not one, or says what cannot be recorded, or told to the robot.
    """
    try:
        name, fields = json.loads(data)
        message: Message = _KINDS[name].validate_python(fields)
        _check_ranges(message)
    except (ValidationError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"not a message of teleop: {data[:60]!r}") from error
    return message


def _check_ranges(message: Message) -> None:
    """Let pass what a recording, and of a request what the tunnel, has room for.

    Its number may be higher than the tunnel's: of these cloud keeps count as it drops them.

    Raises:
        ValueError: If a value does not fit.
    """
    fits = all(_LEAST <= value <= _MOST for value in message if isinstance(value, int))
    if isinstance(message, OperatorRequest):
        least = min(message.number, message.mission_id, message.reached)
        fits = fits and least >= 0 and message.reached <= MISSION_OVER
    if not fits:
        raise ValueError("out of range")
