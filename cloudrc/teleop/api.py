# SPDX-License-Identifier: Apache-2.0

"""Serve teleop's HTTP API: pass requests to the mission service, and answer in JSON.

Only the thread of teleop's loop may call the mission service. The API therefore queues each call on
the `Bridge`, and the loop makes the call.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections import deque
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from fastapi import APIRouter, Depends, FastAPI, Header, HTTPException, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from cloudrc.base.errors import CloudrcError
from cloudrc.base.files import at_place
from cloudrc.config.section import Section
from cloudrc.teleop import models
from cloudrc.teleop.auth import BEARER, REFUSED, Gate
from cloudrc.teleop.refusals import ConflictError, UnavailableError
from cloudrc.teleop.server import ThreadServer
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import Event, MissionRecord
from cloudrc.teleop.wire import RobotStatus, write_line
from cloudrc.version import __version__

ROBOT_PERIOD = 0.033
"""Time between two lines of a stream of the robot's status [s]."""
LOOK_PERIOD = 0.1
"""Time between two checks of an event stream for new events [s]."""
ALIVE_PERIOD = 10.0
"""Time without an event after which the event stream sends a comment to the client [s]."""
ANSWER_LIMIT = 2.0
"""Time limit for the mission service to answer [s]."""
BODY_MAX = 256 * 1024
"""Longest body of a request [bytes]."""
REASONS = {
    **{status: text for status, (_, text) in REFUSED.items()},
    404: "There is no such mission",
    409: "The state of mission or robot forbids it; `id` names the mission in the way",
    413: f"The body is longer than {BODY_MAX // 1024} KiB",
    422: "A value cannot be used; `problems` lists all such values",
    503: "Not now: teleop starts or ends, another teleop has the journal, or the disk refuses it. "
    "Or teleop did not answer within 2 s; look at the state, because it may still act. Cloud "
    "receives an emergency stop all the same, unless another teleop has the journal",
}
REFUSALS: dict[int | str, dict[str, Any]] = {
    code: {"model": models.Refusal, "description": text} for code, text in REASONS.items()
}
ABOUT = """\
Fly missions, or steer by hand. Teleop flies one mission at a time. It refuses a second mission and
names the first, or queues the second with `queue`. Orders with the same `key` make one mission.
Positions are in metres, x forward, y left, z up.

Every request needs a token: `Authorization: Bearer TOKEN`. A reader's token may only read; an
operator's token may also command. `POST /v1/estop` switches the robot off at once. Teleop serves
`POST /v1/estop` and `POST /v1/hold` even while it refuses other requests as too many.
"""
UNKEPT = {"Cache-Control": "no-store"}
"""Headers of a stream."""
STARTING = "teleop is starting"
Call: TypeAlias = Callable[[MissionService, int], Any]
"""Call of the mission service: takes the service and the time [ns], and returns the answer."""
Urgent: TypeAlias = Literal["stop", "hold", ""]
Address: TypeAlias = tuple[str, int] | Path
"""Host and port, or the path of a Unix socket."""


class Bridge:
    """Passes calls from the API's thread, by queues, to the mission service in teleop's loop."""

    def __init__(self) -> None:
        self.closed = STARTING  # why the bridge refuses calls, in words; "" while it accepts calls
        self.alarm: Callable[[], Any] = lambda: None  # sends an emergency stop to cloud at once
        self.overtakings = 0  # number of stops and holds so far; they overtake all other calls
        self._urgent: deque[tuple[Call, Future[Any]]] = deque()  # stops and holds
        self._calls: deque[tuple[Call, Future[Any]]] = deque()
        self._service: MissionService | None = None

    @property
    def seen(self) -> RobotStatus | None:
        """The robot's newest status, read at once, without waiting for teleop's loop."""
        return self._service.seen if self._service else None

    def open(self, service: MissionService) -> None:
        """Accept all calls from now on; teleop's loop makes them on `service`."""
        self._service, self.closed = service, ""

    def close(self, why: str) -> None:
        """Refuse all new calls; answer queued stops and holds with an error that says `why`."""
        self.closed = why
        while self._urgent:
            self._urgent.popleft()[1].set_exception(UnavailableError(why))

    def submit(self, call: Call, urgent: Urgent = "") -> Future[Any]:
        """Queue a call for teleop's loop; the loop makes urgent calls (stops and holds) first.

        Raise an UnavailableError if the bridge is closed. While teleop starts, the bridge accepts
        emergency stops only.
        """
        if self.closed and not (urgent == "stop" and self.closed == STARTING):
            raise UnavailableError(self.closed)
        self.overtakings += bool(urgent)
        future: Future[Any] = Future()
        (self._urgent if urgent else self._calls).append((call, future))
        return future

    async def ask(self, call: Call, urgent: Urgent = "") -> Any:
        """Queue a call for teleop's loop, and return its result.

        For an emergency stop, also send an alarm to cloud at once.
        Raise an UnavailableError if the bridge is closed, or if the loop does not answer within
        `ANSWER_LIMIT`. A stop or hold without an answer stays queued; any other call is withdrawn.
        """
        try:  # queue the stop first: later, telemetry may show it already
            asked = asyncio.wrap_future(self.submit(call, urgent))
        finally:
            if urgent == "stop":
                self.alarm()
        try:
            return await asyncio.wait_for(asyncio.shield(asked) if urgent else asked, ANSWER_LIMIT)
        except TimeoutError:
            text = "teleop did not answer in time, but may still act; look at the state first"
            raise UnavailableError(text) from None

    async def move(self, call: Call) -> Any:
        """Like `ask`, for a call that may move the robot; a later stop or hold cancels the call."""
        known = self.overtakings

        def checked(service: MissionService, now_ns: int) -> Any:
            if self.overtakings != known:
                raise ConflictError("a later stop or hold cancels this; look at the state first")
            return call(service, now_ns)

        return await self.ask(checked)

    def make_stops(self, now_ns: int) -> None:
        """Execute the queued stops and holds; the loop does this before it reads telemetry."""
        self._make(self._urgent, now_ns)

    def make_calls(self, now_ns: int) -> None:
        """Execute all queued calls, the stops and holds first."""
        self._make(self._urgent, now_ns)
        self._make(self._calls, now_ns)

    def _make(self, calls: deque[tuple[Call, Future[Any]]], now_ns: int) -> None:
        for _ in range(len(calls)):
            call, future = calls.popleft()
            assert self._service is not None, "calls are made after `open` only"
            if future.set_running_or_notify_cancel():
                try:
                    result = call(self._service, now_ns)
                    future.set_result(
                        result.as_json() if isinstance(result, MissionRecord) else result
                    )
                except Exception as error:  # the client gets the error
                    future.set_exception(error)


def create_app(
    bridge: Bridge, reader: models.RequestReader, complain: Callable[[str], None]
) -> FastAPI:
    """Make the ASGI application of the API; run it behind a `Gate`, which checks the tokens.

    `reader` reads and checks the bodies of orders. `complain` receives one line about each internal
    error.
    """
    app = FastAPI(
        title="cloudrc teleop",
        version=__version__,
        description=ABOUT,
        docs_url=None,  # its page loads scripts from other sites
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.bridge, app.state.reader = bridge, reader

    @app.exception_handler(CloudrcError)
    async def refuse(request: Request, error: CloudrcError) -> JSONResponse:
        status = getattr(error, "status", 500)
        body: dict[str, Any] = {"detail": str(error)}
        if isinstance(error, models.RefusedError):
            body["problems"] = [models.as_json(problem) for problem in error.problems]
        if isinstance(error, ConflictError):
            body["id"] = error.mission or None
        return JSONResponse(body, status, {"Retry-After": "1"} if status == 503 else None)

    @app.exception_handler(Exception)
    async def fail(request: Request, error: Exception) -> JSONResponse:
        if not isinstance(error, (ClientDisconnect, TimeoutError)):
            complain(f"the API failed at {request.url.path}: {error!r}")
        return JSONResponse({"detail": "the API failed; see teleop's log"}, 500)

    app.include_router(router)
    return app


def _bridge(request: Request) -> Any:
    return request.app.state.bridge


async def _body(request: Request) -> bytes:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > BODY_MAX:
            raise HTTPException(413, REASONS[413])
    return body


def _takes(model: type[Section]) -> dict[str, Any]:
    """Return the OpenAPI description of a request body: the schema and an example of `model`."""
    schema = model.model_json_schema()
    schema = _inline(schema, schema.pop("$defs", {}))
    content = {"application/json": {"schema": schema, "example": models.EXAMPLES[model]}}
    return {"requestBody": {"required": True, "content": content}}


def _inline(value: Any, parts: dict[str, Any]) -> Any:
    """Replace each reference in a schema by the part of `parts` to which it refers."""
    if isinstance(value, list):
        return [_inline(item, parts) for item in value]
    if not isinstance(value, dict):
        return value
    own = {key: _inline(item, parts) for key, item in value.items() if key != "$ref"}
    if "$ref" not in value:
        return own
    return {**_inline(parts[value["$ref"].rpartition("/")[2]], parts), **own}


Body = Annotated[bytes, Depends(_body)]
Bridged = Annotated[Bridge, Depends(_bridge)]
After = Annotated[int, Query(ge=0, lt=10**15)]
LastEvent = Annotated[int, Header(ge=0, lt=10**15)]
router = APIRouter(prefix="/v1", dependencies=[Depends(BEARER)], responses=REFUSALS)


@router.post(
    "/missions",
    status_code=201,
    response_model=models.MissionView,
    responses={200: {"model": models.MissionView, "description": "The mission of this key"}},
    openapi_extra=_takes(models.MissionRequest),
)
async def fly_mission(body: Body, bridge: Bridged, request: Request, response: Response) -> Any:
    """Fly a mission now, or after the missions in the queue."""
    order = await run_in_threadpool(request.app.state.reader.order, body)

    def call(service: MissionService, now_ns: int) -> tuple[dict[str, Any], bool]:
        mission, new = service.create(order, now_ns)
        return mission.as_json(), new

    view, new = await bridge.move(call)
    response.status_code = 201 if new else 200
    return view


@router.get("/missions", response_model=models.MissionList)
async def list_missions(bridge: Bridged) -> Any:
    """List all missions, oldest first."""
    return await bridge.ask(
        lambda service, now_ns: {"missions": [m.summary() for m in service.book.missions.values()]}
    )


@router.get("/missions/{id}", response_model=models.MissionView)
async def show_mission(id: str, bridge: Bridged) -> Any:
    """Show one mission with its events."""
    return await bridge.ask(lambda service, now_ns: service.book.find(id))


@router.post("/missions/{id}/cancel", response_model=models.MissionView)
async def cancel_mission(id: str, bridge: Bridged) -> Any:
    """Cancel a mission that flies or waits."""
    return await bridge.ask(lambda service, now_ns: service.cancel(id, now_ns))


@router.post("/missions/{id}/renew", response_model=models.MissionView)
async def renew_mission(id: str, bridge: Bridged) -> Any:
    """Renew the lease of a mission: its watcher lives.

    An order with `lease_s` is cancelled if this request, or the same order again, does not come for
    that time. To other missions this request does nothing.
    """
    return await bridge.ask(lambda service, now_ns: service.renew(id, now_ns))


@router.post("/hold", response_model=models.MissionView)
async def hold(bridge: Bridged) -> Any:
    """Hold the robot at its position, at least 0.35 m above the floor."""
    return await bridge.ask(MissionService.hold, "hold")


@router.post("/resume", response_model=models.MissionView)
async def resume(bridge: Bridged) -> Any:
    """Fly straight to the next waypoint; the answer is 409 if an obstacle is in the way."""
    return await bridge.move(MissionService.resume)


@router.post("/goto", response_model=models.MissionView, openapi_extra=_takes(models.GoToRequest))
async def go_to(body: Body, bridge: Bridged, request: Request) -> Any:
    """Fly straight to a point, during a held mission or as a new mission."""
    leg = await run_in_threadpool(request.app.state.reader.goto, body)
    return await bridge.move(lambda service, now_ns: service.go_to(leg, now_ns))


@router.post(
    "/drive", response_model=models.MissionSummary, openapi_extra=_takes(models.DriveRequest)
)
async def drive(body: Body, bridge: Bridged, request: Request) -> Any:
    """Drive the setpoint by hand, during a held mission or as a new mission.

    The setpoint accelerates to the velocity with at most 2 m/s^2 and stays inside the fence. Repeat
    this request, for example 10 times a second: 0.5 s after the last request the setpoint brakes to
    rest, and the robot holds there. After a hold, a stop or the end of a mission, let go first:
    send the velocity zero, or nothing for 0.5 s. The answer is 409 while a mission flies.
    """
    velocity, turn = request.app.state.reader.drive(body)
    return await bridge.move(lambda service, now: service.drive(velocity, now, turn).summary())


@router.post("/estop", response_model=models.Stopped)
async def switch_off(bridge: Bridged) -> Any:
    """Switch the robot off at once: it may fall, and needs an acknowledgement to start again."""
    mission = await bridge.ask(MissionService.switch_off, "stop")
    return {"id": mission["id"] if mission else None, "state": "stopping"}


@router.post("/acknowledge", response_model=models.Acknowledged)
async def acknowledge(bridge: Bridged) -> Any:
    """Allow the robot to fly the next mission after an emergency stop or a landing.

    The answer is 409 while an emergency stop is on its way to the robot.
    """
    await bridge.move(MissionService.acknowledge)
    return {"state": "acknowledged"}


@router.get("/state", response_model=models.StateView)
async def show_state(bridge: Bridged) -> Any:
    """Show the mission under way, the queue, and the newest telemetry."""
    return await bridge.ask(MissionService.state)


@router.get(
    "/events",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {}}, "description": "A stream"}},
)
async def stream_events(
    request: Request, bridge: Bridged, after: After = 0, last_event_id: LastEvent = 0
) -> StreamingResponse:
    """Stream the events of all missions after event number `after` as server-sent events.

    The stream ends when the client leaves, its token becomes invalid, or teleop ends. A browser
    that connects again sends the number of its last event as the header Last-Event-ID.
    """
    await bridge.ask(MissionService.state)  # raises an error if teleop cannot answer
    number = max(after, last_event_id)

    def call(service: MissionService, now_ns: int) -> list[Event]:
        return service.book.events_after(number)

    async def stream() -> AsyncIterator[str]:
        nonlocal number
        quiet = 0.0  # time without an event [s]
        yield ": cloudrc\n\n"
        while not bridge.closed and await request.scope["caller"]() is not None:
            try:
                found = await bridge.ask(call)
            except CloudrcError:
                return
            for event in found:
                number = event["id"]
                yield f"id: {number}\nevent: mission\ndata: {json.dumps(event)}\n\n"
            quiet = 0.0 if found else quiet + LOOK_PERIOD
            if quiet >= ALIVE_PERIOD:
                quiet = 0.0
                yield ": alive\n\n"
            await asyncio.sleep(LOOK_PERIOD)

    return StreamingResponse(stream(), media_type="text/event-stream", headers=UNKEPT)


@router.get(
    "/robot",
    response_class=StreamingResponse,
    responses={200: {"content": {"application/jsonl": {}}, "description": "A stream"}},
)
async def stream_robot(request: Request, bridge: Bridged) -> StreamingResponse:
    """Stream the robot's newest status, about 30 times a second, as lines of JSON.

    A line is an object with the fields of `RobotStatus` in cloudrc/teleop/wire.py: pose, velocity
    and guard of the robot, and in `control` the last command. Before the first telemetry, a line is
    null. Unknown values are null. A client that reads too slowly gets old lines, and misses some.
    The stream ends when the client leaves or reads nothing for 30 s, its token becomes invalid, or
    teleop ends.
    """
    await bridge.ask(MissionService.state)  # raises an error if teleop cannot answer

    async def stream() -> AsyncIterator[bytes]:
        while not bridge.closed and await request.scope["caller"]() is not None:
            for _ in range(3):  # `caller` reads files: call it as often as for events
                yield write_line(bridge.seen)
                await asyncio.sleep(ROBOT_PERIOD)

    return StreamingResponse(stream(), media_type="application/jsonl", headers=UNKEPT)


class ApiServer(ThreadServer):
    """Serve the API in a separate thread, from `start` to `stop`."""

    def __init__(self, gate: Gate, bridge: Bridge, address: Address) -> None:
        """Bind the address; with port 0 the kernel chooses a port."""
        if gate.tokens is None and not isinstance(address, Path):
            raise ValueError("in a network, the gate needs tokens")
        # The URL is "http://HOST:PORT", or "unix:PATH" for a Unix socket.
        opened, self.url = _bind(address)
        super().__init__(gate, opened)
        self.gate, self.bridge = gate, bridge

    @property
    def counts(self) -> dict[str, int]:
        """Counts by name: requests with each outcome."""
        return {f"api_{name}": count for name, count in self.gate.counts.items()}

    def stop(self) -> None:
        """Answer the open requests, end the streams, and stop the server."""
        self.bridge.closed = "teleop ends"
        super().stop()


def _bind(address: Address) -> tuple[socket.socket, str]:
    if isinstance(address, Path):
        if address.is_socket():  # an earlier server left it there
            address.unlink()
        unix = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        os.fchmod(unix.fileno(), 0o600)  # Linux gives the file the mode of the socket
        with at_place(f"--api unix:{address}"):
            unix.bind(str(address))
        unix.listen()
        return unix, f"unix:{address}"
    host, port = address[0].strip("[]"), address[1]
    is_6 = ":" in host
    url = f"http://[{host}]" if is_6 else f"http://{host}"
    family = socket.AF_INET6 if is_6 else socket.AF_INET
    with at_place(f"--api {url}:{port}"):
        server = socket.create_server((host, port), family=family, dualstack_ipv6=is_6)
    return server, f"{url}:{server.getsockname()[1]}"
