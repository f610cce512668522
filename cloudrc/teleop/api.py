"""Serve teleop's API over HTTP: carry requests to the mission service, and answer in JSON.

The handlers call the service through the bridge. A refusal has one line of `detail`. The refusal
names the mission in conflict, or each value that cannot be used. Events are sent as they happen, as
server-sent events; each event has a number, so that a client can resume.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from math import radians
from pathlib import Path
from typing import Any, TypeAlias

import uvicorn
from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, StreamingResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from cloudrc import __version__
from cloudrc.config.problems import Problem, in_words
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.teleop import models
from cloudrc.teleop.auth import BEARER, Gate
from cloudrc.teleop.bridge import Bridge, Call
from cloudrc.teleop.models import (
    RefusedError,
    Surroundings,
    check_first_way,
    check_way,
    read_goto,
    read_order,
)
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import ConflictError, UnavailableError, UnknownMissionError

LOOK_PERIOD = 0.1
"""Time between two checks for new events [s]."""
ALIVE_PERIOD = 10.0
"""Time without an event after which the stream sends a comment [s], so that no proxy closes the
connection."""
ANSWER_LIMIT = 2.0
"""Time limit for the mission service to answer [s]."""
ALARM_PERIOD, ALARM_REPEATS = 0.02, 100
"""Time between two attempts to send an emergency stop to a blocked cloud [s], and the number of
attempts."""
HEAD_MAX = 4_096
"""Longest head of a request [bytes]."""
KEEP_ALIVE = 5
"""Time after which a connection without a request is closed [s]."""
BACKLOG = 1_024
"""Limit of the connections that the server has not accepted yet."""
STOP_LIMIT = 1
"""Time limit for open requests when the server stops [s]."""
STATUSES = {BadInputError: 422, ConflictError: 409, UnknownMissionError: 404, UnavailableError: 503}
"""Error -> HTTP status of the answer."""


def _handle_errors(app: FastAPI, complain: Callable[[str], None]) -> None:
    """Make an application answer every error with a `Refusal`."""

    @app.exception_handler(CloudrcError)
    async def refuse(request: Request, error: CloudrcError) -> JSONResponse:
        status = next((code for kind, code in STATUSES.items() if isinstance(error, kind)), 500)
        body: dict[str, Any] = {"detail": str(error)}
        if isinstance(error, RefusedError):
            body["problems"] = [models.as_json(problem) for problem in error.problems]
        if isinstance(error, ConflictError):
            body["id"] = error.mission or None
        return JSONResponse(body, status, {"Retry-After": "1"} if status == 503 else None)

    @app.exception_handler(RequestValidationError)
    async def refuse_query(request: Request, error: RequestValidationError) -> JSONResponse:
        found = [
            Problem(tuple(map(str, each["loc"][1:])), in_words(each["input"]), each["msg"])
            for each in error.errors()
        ]
        return await refuse(request, RefusedError(found))

    @app.exception_handler(TimeoutError)
    async def answer_late(request: Request, error: TimeoutError) -> JSONResponse:
        text = "teleop did not answer in time, but may do it yet: look before you try again"
        return JSONResponse({"detail": text}, 503)

    @app.exception_handler(Exception)
    async def fail(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, ClientDisconnect):
            complain(f"the API failed at {request.url.path}: {error!r}")
        return JSONResponse({"detail": "the API failed; see teleop's log"}, 500)


def create_app(
    bridge: Bridge, surroundings: Surroundings, complain: Callable[[str], None]
) -> FastAPI:
    """Make the ASGI application; it must run behind a `Gate`.

    Args:
        bridge: Bridge to the mission service.
        surroundings: Facts about the experiment.
        complain: Receives one line about each internal error.
    """
    app = FastAPI(
        title="cloudrc teleop",
        version=__version__,
        description=models.ABOUT,
        docs_url=None,  # the pages load scripts from elsewhere
        redoc_url=None,
        redirect_slashes=False,
    )
    _handle_errors(app, complain)
    router = APIRouter(prefix="/v1", dependencies=[Depends(BEARER)], responses=models.REFUSALS)
    _add_missions(router, bridge, surroundings)
    _add_operator(router, bridge, surroundings)
    _add_stop(router, bridge)
    _add_views(router, bridge)
    app.include_router(router)
    return app


async def _ask(bridge: Bridge, call: Call) -> Any:
    return await asyncio.wait_for(asyncio.wrap_future(bridge.submit(call)), ANSWER_LIMIT)


async def _move(bridge: Bridge, call: Call) -> Any:
    """Make a call that may set the robot in motion, unless a stop or a hold overtakes it."""
    return await _ask(bridge, bridge.unless_overtaken(call))


async def _urgent_answer(asked: Future[Any]) -> Any:
    """Wait for the answer to an urgent call, at most `ANSWER_LIMIT`.

    After the limit the call stays queued; other requests may wait for the same call.
    """
    return await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(asked)), ANSWER_LIMIT)


async def _body(request: Request) -> bytes:
    """Read the body of a request; stop reading if the body is too long or arrives too slowly."""
    too_long = HTTPException(413, models.REFUSALS[413]["description"])
    if (
        int(request.headers.get("content-length", "0")) > models.BODY_MAX
    ):  # h11 knows it is a number
        raise too_long
    body = b""
    try:
        async with asyncio.timeout(models.BODY_LIMIT):
            async for chunk in request.stream():
                body += chunk
                if len(body) > models.BODY_MAX:
                    raise too_long
    except TimeoutError:
        raise HTTPException(408, models.REFUSALS[408]["description"]) from None
    return body


def _takes(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """Describe a request body that `_body` reads, for the OpenAPI document."""
    content = {"application/json": {"schema": models.inlined(model), "example": example}}
    return {"requestBody": {"required": True, "content": content}}


def _gives(model: type[BaseModel], text: str) -> dict[str, Any]:
    return {"response_model": None, "responses": {200: {"model": model, "description": text}}}


def _add_missions(router: APIRouter, bridge: Bridge, surroundings: Surroundings) -> None:
    @router.post(
        "/missions",
        status_code=201,
        summary="Fly a mission",
        openapi_extra=_takes(models.MissionRequest, models.MISSION_EXAMPLE),
        response_model=None,
        responses={
            201: {"model": models.MissionView, "description": "It flies, or waits if queued"},
            200: {"model": models.MissionView, "description": "The mission of this key"},
        },
    )
    async def create(request: Request) -> JSONResponse:
        body = await _body(request)
        order = await run_in_threadpool(read_order, body, surroundings)

        def call(service: MissionService, now_ns: int) -> tuple[dict[str, Any], bool]:
            check_first_way(service, order, surroundings.scene)
            mission, new = service.create(order, now_ns)
            return mission.as_json(), new

        view, new = await _move(bridge, call)
        return JSONResponse(view, 201 if new else 200)

    @router.get("/missions", summary="All missions", **_gives(models.MissionList, "Oldest first"))
    async def show_all() -> JSONResponse:
        def call(service: MissionService, now_ns: int) -> list[dict[str, Any]]:
            return [mission.summary() for mission in service.book.missions.values()]

        return JSONResponse({"missions": await _ask(bridge, call)})

    @router.get("/missions/{id}", summary="One mission", **_gives(models.MissionView, "As it is"))
    async def show(id: str) -> JSONResponse:
        return JSONResponse(await _ask(bridge, lambda s, now_ns: s.book.find(id).as_json()))

    @router.post(
        "/missions/{id}/cancel", summary="End a mission", **_gives(models.MissionView, "Ended")
    )
    async def cancel(id: str) -> JSONResponse:
        return JSONResponse(await _ask(bridge, lambda s, now_ns: s.cancel(id, now_ns).as_json()))


def _add_operator(router: APIRouter, bridge: Bridge, surroundings: Surroundings) -> None:
    @router.post("/hold", summary="Stop, 0.35 m up at least", **_gives(models.MissionView, "Held"))
    async def hold() -> JSONResponse:
        asked = bridge.submit(lambda s, now_ns: s.hold(now_ns).as_json(), "hold")
        return JSONResponse(await _urgent_answer(asked))

    @router.post(
        "/resume",
        summary="Go on with what is held",
        description="Straight on to its next waypoint: a pipe's wall in the way is refused (409).",
        **_gives(models.MissionView, "It flies"),
    )
    async def resume() -> JSONResponse:
        def call(service: MissionService, now_ns: int) -> Any:
            check_way(service, None, surroundings.scene)
            return service.resume(now_ns).as_json()

        return JSONResponse(await _move(bridge, call))

    @router.post(
        "/goto",
        summary="Fly to a point",
        description="A mission of its own, or another place for a mission that is held. The way "
        "there is straight: a pipe's wall in it is refused (409).",
        openapi_extra=_takes(models.GoToRequest, models.GOTO_EXAMPLE),
        **_gives(models.MissionView, "On its way"),
    )
    async def go_to(request: Request) -> JSONResponse:
        body = await _body(request)
        point = await run_in_threadpool(read_goto, body, surroundings.scene)

        def call(service: MissionService, now_ns: int) -> Any:
            check_way(service, point.position_m, surroundings.scene)
            return service.go_to(point.position_m, radians(point.yaw_deg), now_ns).as_json()

        return JSONResponse(await _move(bridge, call))


def _add_stop(router: APIRouter, bridge: Bridge) -> None:
    repeating: list[asyncio.Task[None]] = []

    async def repeat_alarm() -> None:
        for _ in range(ALARM_REPEATS):
            await asyncio.sleep(ALARM_PERIOD)
            if bridge.alarm():
                return

    @router.post(
        "/estop",
        summary="Stop the rotors at once",
        description="Whatever the robot does. It falls, and stays off until acknowledged.",
        **_gives(models.Stopped, "The robot is told until it obeys"),
    )
    async def stop() -> JSONResponse:
        try:  # the call is queued before the robot can be seen to have stopped
            asked = bridge.submit(lambda s, now_ns: s.stop_rotors(now_ns), "stop")
        finally:
            while repeating:
                repeating.pop().cancel()
            if not bridge.alarm():  # cloud is blocked
                repeating.append(asyncio.create_task(repeat_alarm()))
        mission = await _urgent_answer(asked)
        return JSONResponse({"id": mission.id if mission else None, "state": "stopping"})

    @router.post(
        "/acknowledge",
        summary="Release a robot that was stopped or has landed",
        description="It arms nothing: the next mission does.",
        **_gives(models.Acknowledged, "The robot is told until it obeys"),
    )
    async def acknowledge() -> JSONResponse:
        await _move(bridge, lambda s, now_ns: s.acknowledge(now_ns))
        return JSONResponse({"state": "acknowledged"})


def _add_views(router: APIRouter, bridge: Bridge) -> None:
    @router.get("/state", summary="How things are", **_gives(models.StateView, "Now"))
    async def state() -> JSONResponse:
        return JSONResponse(await _ask(bridge, lambda s, now_ns: s.state(now_ns)))

    @router.get(
        "/events",
        summary="What happens, as it happens",
        description="Server-sent events, one for each event of all missions, from the oldest that "
        "is known. Resume with the header Last-Event-ID, or with `?after=ID`.",
        response_class=StreamingResponse,
        responses={200: {"content": {"text/event-stream": {}}, "description": "A stream"}},
    )
    async def events(request: Request, after: int = 0) -> StreamingResponse:
        last = request.headers.get("last-event-id", "")
        if last.isdecimal() and len(last) < 16:
            after = max(after, int(last))
        await _ask(bridge, lambda s, now_ns: None)  # refuse now what cannot be served
        stream = _stream(request, bridge, after)
        headers = {"Cache-Control": "no-store"}
        return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


async def _stream(request: Request, bridge: Bridge, after: int) -> AsyncIterator[str]:
    """Yield events until the client disconnects, its token becomes invalid, or teleop ends."""
    looks = 0
    yield ": cloudrc\n\n"
    while not (bridge.closed or await request.is_disconnected()):
        if await request.scope["caller"]() is None:
            return
        try:
            events = await _ask(bridge, _events_after(after))
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


def _events_after(number: int) -> Call:
    return lambda service, now_ns: service.book.events_after(number)


Address: TypeAlias = tuple[str, int] | Path
"""Host and port, or the path of a Unix socket."""


class ApiServer:
    """Serve the API in a separate thread, from `start` to `stop`.

    Attributes:
        url: "http://HOST:PORT", or "unix:PATH" for a Unix socket.
        gate: Admits the callers, and counts their requests.
    """

    def __init__(self, gate: Gate, bridge: Bridge, address: Address) -> None:
        """Bind the address; port 0 lets the kernel choose.

        Raises:
            BadInputError: If the address cannot be bound, or if there are no tokens and the address
                is not a socket file: then everybody could command.
        """
        if gate.tokens is None and not isinstance(address, Path):
            raise BadInputError(
                "--api HOST:PORT needs --tokens DIR, with a file 'operator' in it; "
                "without tokens only a socket file is served: --api unix:PATH"
            )
        self.gate, self._bridge = gate, bridge
        self._socket, self.url = _bind(address)
        self._server = uvicorn.Server(
            uvicorn.Config(
                gate,
                loop="asyncio",
                http="h11",
                ws="none",
                lifespan="off",
                log_level="critical",  # a flood does not fill the log
                access_log=False,  # the audit log has the commands
                server_header=False,
                proxy_headers=False,  # the audit log names whoever connects
                # No limit_concurrency: uvicorn would refuse an emergency stop, too.
                backlog=BACKLOG,
                h11_max_incomplete_event_size=HEAD_MAX,
                timeout_keep_alive=KEEP_ALIVE,
                timeout_graceful_shutdown=STOP_LIMIT,
            )
        )
        # A daemon, so that a client that hangs cannot keep the process from ending.
        run = self._server.run
        self._thread = threading.Thread(target=run, args=([self._socket],), daemon=True)

    @property
    def counts(self) -> dict[str, int]:
        """Number of requests by outcome, and number of lost lines of the audit log."""
        audit = self.gate.audit
        return {**self.gate.counts, "audit_dropped": audit.dropped if audit else 0}

    def start(self) -> None:
        """Start serving; clients can connect from now on."""
        self._socket.listen(BACKLOG)
        self._thread.start()

    def stop(self) -> None:
        """Answer the open requests, end the streams, and stop."""
        self._bridge.closed = "teleop ends"
        self._server.should_exit = True
        self._thread.join(STOP_LIMIT)
        self._socket.close()
        if self.gate.audit is not None:
            self.gate.audit.stop()


def _bind(address: Address) -> tuple[socket.socket, str]:
    """Bind a socket to an address; return socket and URL."""
    if isinstance(address, Path):
        return _bind_file(address), f"unix:{address}"
    host, port = address[0].strip("[]"), address[1]
    shown = f"[{host}]" if ":" in host else host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio disables Nagle's algorithm only if the socket names its protocol.
    tcp = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if family == socket.AF_INET6:
        tcp.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)  # [::] serves IPv4, too
    try:
        tcp.bind((host, port))
    except (OSError, UnicodeError) as error:  # no host has a name with an empty label
        tcp.close()
        reason = getattr(error, "strerror", None) or error
        raise BadInputError(f"--api {shown}:{port}: {reason}; choose another address") from error
    return tcp, f"http://{shown}:{tcp.getsockname()[1]}"


def _bind_file(path: Path) -> socket.socket:
    """Bind a Unix socket to which, from the start, only its owner can connect."""
    unix = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    os.fchmod(unix.fileno(), 0o600)  # Linux gives the file the mode of the socket
    try:
        if path.is_socket():  # an earlier server left it there
            path.unlink()
        unix.bind(str(path))
    except OSError as error:
        unix.close()
        text = f"--api unix:{path}: {error.strerror or error}; choose another path"
        raise BadInputError(text) from error
    return unix
