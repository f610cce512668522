"""Server-sent events: the book's events go out as they come, numbered, so that one can resume."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from fastapi import Request

from cloudrc.cloud.teleop.api_bridge import Call
from cloudrc.errors import CloudrcError

LOOK_PERIOD = 0.1
"""Between two looks at the book [s]."""
ALIVE_PERIOD = 10.0
"""After so long without an event a comment is sent, so that no proxy closes the stream [s]."""


def last_event_id(request: Request) -> int:
    """Where a client that was cut off left; 0 if it does not say."""
    text = request.headers.get("last-event-id", "")
    return int(text) if text.isdecimal() and len(text) < 16 else 0


async def stream(
    request: Request,
    ask: Callable[[Call], Awaitable[Any]],
    closed: Callable[[], bool],
    after: int,
) -> AsyncIterator[str]:
    """Give the text of the stream, until the client leaves or teleop ends.

    Args:
        request: Of the client.
        ask: Has a call made on the service.
        closed: Whether teleop ends.
        after: Number of the last event that the client has.
    """
    looks = 0
    yield ": cloudrc\n\n"
    while not closed() and not await request.is_disconnected():
        try:
            events = await ask(_after(after))
        except (CloudrcError, TimeoutError):
            return
        for event in events:
            after = event["id"]
            yield f"id: {after}\nevent: mission\ndata: {json.dumps(event)}\n\n"
        looks = 0 if events else looks + 1
        if looks * LOOK_PERIOD >= ALIVE_PERIOD:
            looks = 0
            yield ": alive\n\n"
        await asyncio.sleep(LOOK_PERIOD)


def _after(number: int) -> Call:
    return lambda service, now_ns: service.book.events_after(number)
