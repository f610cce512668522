# SPDX-License-Identifier: Apache-2.0

"""Call the HTTP API of teleop, the process that commands missions.

The API is at http://HOST:PORT, which needs a token, or at unix:PATH, a socket file that only its
owner can open. Behind a proxy, a path may follow http://HOST:PORT.
"""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlsplit

from cloudrc.base.errors import CloudrcError, RejectedError
from cloudrc.base.outside.paths import TOKEN_VARIABLE
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.text import escape

if TYPE_CHECKING:
    from cloudrc.teleop.wire import RobotStatus

REQUEST_TIMEOUT = 10.0
"""Time limit of one request [s]."""
STREAM_TIMEOUT = 30.0
"""Time without data after which the client stops reading a stream of events [s]. The API sends data
at least every 10 s."""
ROBOT_TIMEOUT = 1.0
"""Time without data after which the client stops reading the stream of the robot's status [s]. The
API sends data 30 times a second."""
RETRY_STATUSES = (408, 429, 502, 503, 504)
"""HTTP status codes after which the same request may succeed later."""
FOREIGN = (
    "a proxy or another program is there, or a proxy changes paths; give the API's address, with"
    " the path of a proxy: --api http://HOST:PORT/PATH"
)
"""What to do if the answer is not from teleop."""
ALL_MET = "every waypoint reached, every criterion met"
"""Says what a robot has done in a mission of waypoints that succeeded."""
UNIX = "unix:"
FORMS = "http://HOST:PORT[/PATH] or unix:PATH"
"""What an address of the API looks like."""


class ApiError(CloudrcError):
    """Report that the API answers a request with an error."""

    exit_code = 5


class UnreachableError(ApiError):
    """Report that the API does not answer now; the same request may succeed later."""


class Api:
    """Call teleop's API at one address."""

    def __init__(self, url: str, token: Callable[[], str] = lambda: "", place: str = "") -> None:
        """Store the address, "http://HOST:PORT[/PATH]" or "unix:PATH".

        Raise an InvalidValueError for another one.

        `token` is called for each request; it returns the current token, or "" for none. `place`
        is the name of the run or release for messages; "" if the user gave the address.
        """
        self.url, self._token, self.place = url.rstrip("/"), token, place
        self._prefix = ""  # path of the API behind a proxy
        try:
            self._connection(REQUEST_TIMEOUT)
        except (ValueError, KeyError, http.client.InvalidURL):
            raise InvalidValueError(f"'{url}' is not {FORMS}") from None

    def get(self, path: str) -> Any:
        """Send a GET request; result and errors are those of `post`."""
        return self._ask("GET", path, None)

    def post(self, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """Send a POST request; return the decoded JSON of the answer.

        Raises:
            UnreachableError: If there is no answer, or if teleop is busy or not ready yet.
            RejectedError: If a value is invalid.
            ApiError: If the API answers with another error.
        """
        return self._ask("POST", path, b"" if body is None else json.dumps(body).encode())

    def events(self, after: int = 0) -> Iterator[dict[str, Any]]:
        """Yield the events with an id above `after`, of all missions, until teleop ends."""
        with self._answer("GET", f"/v1/events?after={after}", None, STREAM_TIMEOUT) as stream:
            for line in stream:
                if line.startswith(b"data: "):
                    yield json.loads(line.removeprefix(b"data: "))

    def robot(self) -> Iterator[RobotStatus | None]:
        """Yield the robot's newest status 30 times a second until teleop ends."""
        from cloudrc.teleop.wire import read_line

        with self._answer("GET", "/v1/robot", None, ROBOT_TIMEOUT) as stream:
            for line in stream:
                yield read_line(line)

    @contextmanager
    def _answer(
        self, method: str, path: str, body: bytes | None, limit: float
    ) -> Iterator[http.client.HTTPResponse]:
        """Send a request and yield the answer; raise an error for any HTTP status other than 2xx.

        `limit` is the longest wait for the server [s].
        """
        token = self._token()
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        with closing(self._connection(limit)) as connection:
            try:
                connection.request(method, self._prefix + path, body, headers)
                answer = connection.getresponse()
                is_page = answer.headers.get_content_type() == "text/html"
                if is_page or not 200 <= answer.status < 300:
                    raise _error_of(answer, self.place, with_token=bool(token))
                yield answer
            except (OSError, ValueError, http.client.HTTPException) as error:
                why = getattr(error, "strerror", None) or error
                raise UnreachableError(f"the API at {self.url} does not answer ({why})") from None

    def _ask(self, method: str, path: str, body: bytes | None) -> Any:
        with self._answer(method, path, body, REQUEST_TIMEOUT) as answer:
            return json.loads(answer.read())

    def _connection(self, limit: float) -> http.client.HTTPConnection:
        """Make a connection without a proxy: the API is on this machine or in the cluster."""
        if self.url.startswith(UNIX):
            return _UnixConnection(self.url.removeprefix(UNIX), limit)
        parts = urlsplit(self.url)
        kinds: dict[str, type[http.client.HTTPConnection]] = {
            "http": http.client.HTTPConnection,
            "https": http.client.HTTPSConnection,
        }
        if not parts.hostname:
            raise ValueError(self.url)
        self._prefix = parts.path
        kind = kinds[parts.scheme]
        # Without a port, http.client would read one from an IPv6 address.
        return kind(parts.hostname, parts.port or kind.default_port, timeout=limit)


class _UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: str, limit: float) -> None:
        super().__init__("localhost", timeout=limit)
        if not path:
            raise ValueError(path)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


def mission_path(mission_id: str) -> str:
    """Return the URL path of a mission; quote special characters of its id."""
    return f"/v1/missions/{quote(mission_id, safe='', errors='surrogateescape')}"


def _error_of(answer: http.client.HTTPResponse, place: str, *, with_token: bool) -> CloudrcError:
    """Return the error for an answer of the API that is no success."""
    detail = _detail(answer)
    if answer.status == 401:
        which = "does not know this token" if with_token else "asks for a token"
        detail = f"the API {which}; name its file: --token-file FILE or {TOKEN_VARIABLE}"
    detail = f"{place}: {detail}" if place else detail
    if answer.status in (400, 413, 422):
        return RejectedError(detail)
    return UnreachableError(detail) if answer.status in RETRY_STATUSES else ApiError(detail)


def _detail(answer: http.client.HTTPResponse) -> str:
    """Return the reason that the API gives for an error; a line for each of several problems."""
    status = f"the API answered {answer.status} {answer.reason}"
    try:
        body = json.loads(answer.read())
        detail, problems = str(body["detail"]), body.get("problems") or []
    except (OSError, ValueError, TypeError, KeyError, http.client.HTTPException):
        return escape(status if answer.status in RETRY_STATUSES else f"{status}: {FOREIGN}")
    if (answer.status, detail) == (404, "Not Found"):  # for a path, not for a mission
        return escape(f"{status}: {FOREIGN}")
    if len(problems) <= 1:
        return escape(detail)
    parts = ([p[k] for k in ("path", "value", "reason") if p[k]] for p in problems)
    lines = [escape(": ".join(words)) for words in parts]
    return "\n  ".join([f"the mission has {len(lines)} problems:", *lines])


def find_mission(api: Api, key: str) -> dict[str, Any] | None:
    """Return the mission with a key; None if there is none."""
    missions = api.get("/v1/missions")["missions"]
    return next((mission for mission in missions if mission["key"] == key), None)


def describe_mission(mission: Mapping[str, Any]) -> str:
    """Return name, state and waypoint of a mission, and its verdict, as one line of text."""
    where, met = f"waypoint {mission['waypoint'] + 1} of {mission['waypoints']}", ALL_MET
    if not mission["waypoints"]:
        where, met = "setpoints of a file", "flown to the end; the report judges how near"
    name = f" ({mission['name']})" if mission["name"] else ""
    verdict = f"; {describe_verdict(mission['verdict'], met)}" if mission["verdict"] else ""
    return f"mission {mission['id']}{name}: {mission['state']}, {where}{verdict}"


def describe_verdict(verdict: Mapping[str, Any], met: str = ALL_MET) -> str:
    """Return the outcome of a mission and the reasons, as one line of text.

    `met` says what the robot has done if the mission succeeded.
    """
    failures = [f"{failure['code']}: {failure['text']}" for failure in verdict["failures"]]
    reasons = "; also ".join(failures) or met
    return f"{verdict['outcome'].upper()}: {reasons}"
