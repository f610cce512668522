"""The API of teleop: HTTP requests come in; verbs go to the mission service, JSON goes out.

Handlers wait for the service on the bridge and touch nothing else of it. Errors are one line of
`detail`; a mission that is in the way is named, and so is every value that cannot be used.

Server-sent events: the book's events go out as they come, numbered, so that one can resume.

What the API answers when it does not do what was asked: an exception comes in, JSON goes out.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from math import radians
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, StreamingResponse
from fastapi.security import HTTPBearer
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from cloudrc import __version__
from cloudrc.config.problems import Problem, in_words
from cloudrc.config.schema import Mission as MissionSection
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.geometry.scene import Scene
from cloudrc.teleop import models
from cloudrc.teleop.auth import RevokedError
from cloudrc.teleop.bridge import Bridge, Call
from cloudrc.teleop.models import (
    Refusal,
    RefusedError,
    as_json,
    check_first_way,
    check_way,
    leads_to_board,
    read_goto,
    read_mission,
)
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import ConflictError, Order, UnavailableError, UnknownMissionError
from cloudrc.teleop.wire import Plan

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


BODY_MAX = 256 * 1024
"""Length of a request's body [bytes]."""
BODY_LIMIT = 5.0
"""For a request's body to arrive [s]."""

REFUSALS: dict[int | str, dict[str, Any]] = {
    code: {"model": Refusal, "description": text}
    for code, text in {
        401: "There is no valid token in the request",
        403: "The token is a reader's",
        404: "There is no such mission",
        408: f"The body did not arrive within {BODY_LIMIT:g} s",
        409: "The state does not allow it; `id` names the mission in the way",
        413: f"The body is longer than {BODY_MAX // 1024} KiB",
        422: "A value cannot be used; `problems` has every one",
        429: "Too many requests; try again in a second",
        503: "Not now: teleop starts or ends, another has the journal, it cannot be written, or "
        "too much waits: try again. Or teleop did not answer within 2 s, and may do it yet: look. "
        "An emergency stop is told all the same, unless another teleop flies the robot",
    }.items()
}


class TooLargeError(CloudrcError):
    """The body of a request is too long."""


class TooSlowError(CloudrcError):
    """The body of a request does not arrive."""


def handle_errors(app: FastAPI) -> None:
    """Let an application answer with `Refusal` for everything that cannot be done."""

    @app.exception_handler(CloudrcError)
    async def refuse(request: Request, error: CloudrcError) -> JSONResponse:
        match error:
            case RefusedError():
                problems = [as_json(problem) for problem in error.problems]
                return JSONResponse({"detail": str(error), "problems": problems}, 422)
            case BadInputError():
                return JSONResponse({"detail": str(error)}, 422)
            case ConflictError():
                return JSONResponse({"detail": str(error), "id": error.mission or None}, 409)
            case UnknownMissionError():
                return JSONResponse({"detail": str(error)}, 404)
            case RevokedError():
                text = REFUSALS[401]["description"]
                return JSONResponse({"detail": text}, 401, {"WWW-Authenticate": "Bearer"})
            case TooLargeError():
                return JSONResponse({"detail": REFUSALS[413]["description"]}, 413)
            case TooSlowError():
                return JSONResponse({"detail": REFUSALS[408]["description"]}, 408)
            case UnavailableError():
                return JSONResponse({"detail": str(error)}, 503, {"Retry-After": "1"})
        return JSONResponse({"detail": str(error)}, 500)

    @app.exception_handler(RequestValidationError)
    async def refuse_query(request: Request, error: RequestValidationError) -> JSONResponse:
        found = [
            Problem(tuple(map(str, each["loc"][1:])), in_words(each["input"]), each["msg"])
            for each in error.errors()
        ]
        return await refuse(request, RefusedError(found))

    @app.exception_handler(Exception)
    async def fail(request: Request, error: Exception) -> JSONResponse:
        return JSONResponse({"detail": "the API failed; see teleop's log"}, 500)

    @app.exception_handler(ClientDisconnect)
    async def gone(request: Request, error: ClientDisconnect) -> JSONResponse:
        return JSONResponse({"detail": "the client has left"}, 400)  # for the audit log alone

    @app.exception_handler(TimeoutError)
    async def too_late(request: Request, error: TimeoutError) -> JSONResponse:
        text = "teleop did not answer in time, but may do it yet: look before you try again"
        return JSONResponse({"detail": text}, 503)


ABOUT = """\
Fly missions, or steer by hand. One mission is flown at a time; a second one is refused with the
id of the first, or waits if it says `queue`. A mission posted again under the same `key` is not
made again. Positions are in metres, x forward, y left, z up.

Every request needs a token: `Authorization: Bearer TOKEN`. A reader's may look, an operator's may
command. `POST /v1/estop` stops the rotors at once and is served even while a flood is refused.
"""
ANSWER_LIMIT = 2.0
"""For the mission service to answer [s]."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What the API needs to know of the experiment.

    Attributes:
        scene: That waypoints are checked against.
        time_limit: Of missions that do not say theirs [s].
        contact: Whether missions that do not say, and lead to the board, have to touch it.
        plan: Turns a checked mission and its limit of time [s] into a plan.
    """

    scene: Scene
    time_limit: float
    contact: bool
    plan: Callable[[MissionSection, float], Plan]


BEARER = HTTPBearer(auto_error=False, description="An operator's token, or a reader's for GET")
"""For the description alone: the gate before the application checks every token."""


def create_app(bridge: Bridge, surroundings: Surroundings) -> FastAPI:
    """Make the ASGI application; it belongs behind a gate."""
    app = FastAPI(
        title="cloudrc teleop",
        version=__version__,
        description=ABOUT,
        docs_url=None,  # their pages load scripts from elsewhere
        redoc_url=None,
    )
    handle_errors(app)
    router = APIRouter(prefix="/v1", dependencies=[Depends(BEARER)], responses=REFUSALS)
    _add_missions(router, bridge, surroundings)
    _add_operator(router, bridge, surroundings)
    _add_stops(router, bridge)
    _add_views(router, bridge)
    app.include_router(router)
    return app


async def _ask(bridge: Bridge, call: Call) -> Any:
    return await _answer(asyncio.wrap_future(bridge.submit(call)))


async def _answer(future: asyncio.Future[Any]) -> Any:
    return await asyncio.wait_for(future, ANSWER_LIMIT)


async def _body(request: Request) -> bytes:
    """Read a body that is neither too long nor too slow; another one is not read to its end."""
    said = request.headers.get("content-length", "0")
    if said.isdecimal() and int(said[:12]) > BODY_MAX:
        raise TooLargeError
    body = b""
    try:
        async with asyncio.timeout(BODY_LIMIT):
            async for chunk in request.stream():
                body += chunk
                if len(body) > BODY_MAX:
                    raise TooLargeError
    except TimeoutError:
        raise TooSlowError from None
    return body


def _takes(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """Describe a body that is read by `_body`."""
    content = {"application/json": {"schema": models.inlined(model), "example": example}}
    return {"requestBody": {"required": True, "content": content}}


def _gives(model: type[BaseModel], text: str, code: int = 200) -> dict[str, Any]:
    return {"response_model": None, "responses": {code: {"model": model, "description": text}}}


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
        order = await run_in_threadpool(_order, body, surroundings)

        def call(service: MissionService, now_ns: int) -> tuple[dict[str, Any], bool]:
            check_first_way(service, order, surroundings.scene)
            mission, new = service.create(order, now_ns)
            return mission.as_json(), new

        view, new = await _ask(bridge, call)
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
        return JSONResponse(await _ask(bridge, lambda s, now_ns: s.hold(now_ns).as_json()))

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

        return JSONResponse(await _ask(bridge, call))

    @router.post(
        "/goto",
        summary="Fly to a point",
        description="A mission of its own, or another place for a mission that is held. The way "
        "there is straight: a pipe's wall in it is refused (409).",
        openapi_extra=_takes(models.GoToRequest, {"position_m": [0.5, 0.0, 1.2], "yaw_deg": 0.0}),
        **_gives(models.MissionView, "On its way"),
    )
    async def go_to(request: Request) -> JSONResponse:
        body = await _body(request)
        point = await run_in_threadpool(read_goto, body, surroundings.scene)

        def call(service: MissionService, now_ns: int) -> Any:
            check_way(service, point.position_m, surroundings.scene)
            return service.go_to(point.position_m, radians(point.yaw_deg), now_ns).as_json()

        return JSONResponse(await _ask(bridge, call))


def _add_stops(router: APIRouter, bridge: Bridge) -> None:
    @router.post(
        "/estop",
        summary="Stop the rotors at once",
        description="Whatever the robot does. It falls, and stays off until acknowledged.",
        **_gives(models.Stopped, "The robot is told until it obeys"),
    )
    async def stop() -> JSONResponse:
        try:  # the call is there before the robot can be seen to have stopped
            stopped = bridge.submit(lambda s, now_ns: s.stop_rotors(now_ns), urgent=True)
        finally:
            bridge.alarm()
        mission = await _answer(asyncio.shield(asyncio.wrap_future(stopped)))  # made, however late
        return JSONResponse({"id": mission.id if mission else None, "state": "stopping"})

    @router.post(
        "/acknowledge",
        summary="Release a robot that was stopped or has landed",
        description="It arms nothing: the next mission does.",
        **_gives(models.Acknowledged, "The robot is told until it obeys"),
    )
    async def acknowledge() -> JSONResponse:
        await _ask(bridge, bridge.unless_stopped(lambda s, now_ns: s.acknowledge(now_ns)))
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
        began = max(after, last_event_id(request))
        await _ask(bridge, lambda s, now_ns: None)  # is it there?
        ask = lambda call: _ask(bridge, call)  # noqa: E731
        return StreamingResponse(
            stream(request, ask, lambda: bool(bridge.closed), began),
            media_type="text/event-stream",
            headers={"Cache-Control": "no-store"},
        )


def _order(body: bytes, surroundings: Surroundings) -> Order:
    request, mission = read_mission(body, surroundings.scene)
    limit = surroundings.time_limit if request.time_limit_s is None else request.time_limit_s
    contact = request.contact
    if contact is None:
        contact = surroundings.contact and leads_to_board(mission, surroundings.scene)
    plan = surroundings.plan(mission, limit)
    return Order(plan, request.name, request.key, contact, request.queue)
