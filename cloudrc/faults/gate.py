"""The gate of teleop's API without a server: requests go in, what it has counted comes out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from cloudrc.teleop.models import RefusedError
from cloudrc.teleop.server import App, Gate, Receive, Scope, Send
from cloudrc.teleop.store import ConflictError


def counted(application: App, method: str, path: str, count: int = 1) -> Counter[str]:
    """Ask so many times at once, as the robot's owner.

    Args:
        application: Behind the gate; it must wait for nobody.
        method: Of HTTP.
        path: What for.
        count: How often.
    """

    async def nothing(message: Any = None) -> Any:
        return {}

    gate = Gate(application, tokens=None)
    for _ in range(count):
        asking = gate({"method": method, "path": path, "headers": []}, nothing, nothing)
        with suppress(StopIteration):
            asking.send(None)
    return gate.counts


def ordered(order: Callable[[], object]) -> Counter[str]:
    """Post one mission; what `order` raises becomes the status that the API gives it."""

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        status = 201
        try:
            order()
        except RefusedError:
            status = 422
        except ConflictError:
            status = 409
        await send({"type": "http.response.start", "status": status, "headers": []})

    return counted(application, "POST", "/v1/missions")
