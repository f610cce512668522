"""What the API answers when it does not do what was asked: an exception comes in, JSON goes out."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect

from cloudrc.cloud.teleop.api_check import RefusedError, as_json
from cloudrc.cloud.teleop.api_models import Refusal
from cloudrc.cloud.teleop.api_tokens import RevokedError
from cloudrc.cloud.teleop.service_book import (
    ConflictError,
    UnavailableError,
    UnknownMissionError,
)
from cloudrc.config.problems import Problem, in_words
from cloudrc.errors import BadInputError, CloudrcError

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
