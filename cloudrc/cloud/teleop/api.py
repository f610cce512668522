"""The API of teleop: HTTP requests come in; verbs go to the mission service, JSON goes out.

Handlers wait for the service on the bridge and touch nothing else of it. Errors are one line of
`detail`; a mission that is in the way is named, and so is every value that cannot be used.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from math import radians
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.responses import JSONResponse, StreamingResponse
from fastapi.security import HTTPBearer
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from cloudrc import __version__
from cloudrc.cloud.teleop import api_models as models
from cloudrc.cloud.teleop.api_bridge import Bridge, Call
from cloudrc.cloud.teleop.api_check import (
    check_first_way,
    check_way,
    leads_to_board,
    read_goto,
    read_mission,
)
from cloudrc.cloud.teleop.api_errors import (
    BODY_LIMIT,
    BODY_MAX,
    REFUSALS,
    TooLargeError,
    TooSlowError,
    handle_errors,
)
from cloudrc.cloud.teleop.api_events import last_event_id, stream
from cloudrc.cloud.teleop.plan import Plan
from cloudrc.cloud.teleop.service import MissionService
from cloudrc.cloud.teleop.service_mission import Order
from cloudrc.config.schema import Mission as MissionSection
from cloudrc.geometry.scene import Scene

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
        openapi_extra=_takes(models.GoToRequest, {"position_m": [0.0, 0.0, 1.2], "yaw_deg": 0.0}),
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
