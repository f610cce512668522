# SPDX-License-Identifier: Apache-2.0

"""Listen at the console's address: check every request, switch the robot off, show the plain page.

The door has a thread of its own and does not draw, so that STOP never waits for the scene. It
passes the WebSockets of checked pages on to viser, up to `PAGES_MAX`.
"""

from __future__ import annotations

import asyncio
import html
import json
import socket
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import websockets.asyncio.server
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from cloudrc.base.files import at_place
from cloudrc.doors.console.access import PARAMETER, Access
from cloudrc.flight.local.places import socket_folder
from cloudrc.teleop.server import ThreadServer

if TYPE_CHECKING:
    from cloudrc.doors.console.page import Page

PAGES_MAX = 50
"""Largest number of pages that have the scene; each further one gets the plain page."""
HEAD_MAX = 16_384
"""Size limit of a request's head [bytes]."""
HEAD_TIME = 10.0
"""Time limit for a browser to send its first request [s]."""
MESSAGE_MAX = 1 << 20
"""Size limit of a message from a browser [bytes]."""
COPIED_MAX = 1 << 16
"""Largest number of bytes that are copied at once."""
NO_TOKEN = (
    "This address lacks the console's token, or has an old one. "
    "Open the address that 'cloudrc console' has printed."
)
FOREIGN = (
    "This address is not the console's own. If a proxy of yours serves it, "
    "start the console with --allow-origin and this origin."
)
END_OF_HEAD = b"\r\n\r\n"
HEADERS = [
    ("Cache-Control", "no-store"),
    ("Referrer-Policy", "no-referrer"),
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "SAMEORIGIN"),
]
"""Headers of every answer."""
WEB = Path(__file__).parent / "web"
"""Folder of the pages' parts."""


class _FirstHead(asyncio.Protocol):
    """Pass a new connection on to uvicorn; end it if its first request takes over `HEAD_TIME`."""

    def __init__(self, **settings: Any) -> None:
        self._http = H11Protocol(**settings)
        self._head = b""

    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        self._end = asyncio.get_running_loop().call_later(HEAD_TIME, transport.abort)
        self._http.connection_made(transport)

    def data_received(self, data: bytes) -> None:
        self._head += data  # uvicorn ends a connection with more than `HEAD_MAX`
        if END_OF_HEAD in self._head:
            self._end.cancel()
            self._transport.set_protocol(self._http)
        self._http.data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._end.cancel()
        self._http.connection_lost(exc)


class Door(ThreadServer):
    """The console's server."""

    def __init__(self, listen: tuple[str, int], access: Access, page: Page, scene: str) -> None:
        """Open the port (0: any free one); answer after `start`.

        Args:
            listen: IP address and TCP port.
            access: Rules by which requests are admitted.
            page: Carries out what browsers ask for.
            scene: HTML of the page with the scene.
        """
        with at_place(f"--port {listen[1]}"):
            opened = socket.create_server(listen, backlog=512)
        self.port: int = opened.getsockname()[1]
        self._folder = TemporaryDirectory(prefix="cloudrc-", dir=socket_folder())
        self.viser = f"{self._folder.name}/viser.sock"  # only this user may enter its folder
        self._access, self._page, self._scene = access, page, scene
        self._open = 0  # pages that have the scene
        self._routes = Starlette(
            routes=[
                Route("/{name:path}", self._show, methods=["GET"]),
                Route("/{name:path}", self._act, methods=["POST"]),
            ]
        )
        super().__init__(
            self._check,
            opened,
            _FirstHead,
            self._web_socket,
            headers=HEADERS,
            h11_max_incomplete_event_size=HEAD_MAX,
        )

    def stop(self) -> None:
        """Stop to answer."""
        super().stop()
        self._folder.cleanup()

    async def _check(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request of the own page with the token; turn all others away unread."""
        answer = self._refusal(HTTPConnection(scope)) or self._routes
        await answer(scope, receive, send)

    def _refusal(self, request: HTTPConnection) -> Response | None:
        """Return the answer to a request that is not admitted, else None."""
        if not self._access.is_own_page(request):
            return PlainTextResponse(FOREIGN, 403)
        return None if self._access.has_token(request) else PlainTextResponse(NO_TOKEN, 403)

    async def _show(self, request: Request) -> Response:
        name = request.path_params["name"]
        if PARAMETER in request.query_params:
            return self._keep_token(request)
        if name == "state":
            return JSONResponse(self._state())
        if name == "plain" or (name == "" and self._open >= PAGES_MAX):
            return HTMLResponse(plain_page(self._state()["lines"]))
        return HTMLResponse(self._scene) if name == "" else Response(status_code=404)

    def _keep_token(self, request: Request) -> Response:
        """Move the token from the address to a cookie.

        The cookie has no path: the browser takes that of the page, also behind a proxy.
        """
        target = request.url.remove_query_params(PARAMETER)
        name = target.path.rpartition("/")[2]
        location = f"./{name}" + (f"?{target.query}" if target.query else "")
        answer = Response(status_code=303, headers={"Location": location})
        token = self._access.token()
        answer.set_cookie(self._access.cookie, token, path=None, httponly=True, samesite="lax")
        return answer

    def _state(self) -> dict[str, Any]:
        """Return the state, the buttons of the plain page, and whether all scenes are taken."""
        is_read_only = self._page.pilot is not None
        lines = ["Read only: another browser steers."] if is_read_only else []
        acts = [] if is_read_only else list(self._page.acts)
        lines += self._page.describe()
        return {"lines": lines, "acts": acts, "is_full": self._open >= PAGES_MAX}

    async def _act(self, request: Request) -> Response:
        """Carry out what a page asks for."""
        name = request.path_params["name"]
        if name == "stop":
            self._page.steering.stop()
            return PlainTextResponse("switching the robot off", 202)
        if (act := self._page.acts.get(name)) is None:
            return Response(status_code=404)
        if self._page.pilot is not None:
            return PlainTextResponse("another browser steers", 409)
        answer = await run_in_threadpool(act)
        return PlainTextResponse(answer.words)

    def _web_socket(self, **_: Any) -> asyncio.StreamReaderProtocol:
        """Take a connection over from uvicorn, which writes the head of its request again."""
        return asyncio.StreamReaderProtocol(asyncio.StreamReader(), self._serve_scene)

    async def _serve_scene(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Let viser serve the WebSocket of an admitted page, and turn any other one away."""
        with suppress(OSError), closing(writer):
            head = await reader.readuntil(END_OF_HEAD)
            answer = self._refusal(_read_head(head))
            if answer is None and self._open >= PAGES_MAX:
                answer = Response(status_code=503)
            if answer is not None:
                writer.write(_as_bytes(answer))
                return
            self._open += 1
            try:
                await self._pass_on(reader, writer, head)
            finally:
                self._open -= 1

    async def _pass_on(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, head: bytes
    ) -> None:
        """Connect a page with viser until one of them ends; `head` begins the page's request."""
        from_viser, to_viser = await asyncio.open_unix_connection(self.viser)
        with closing(to_viser):
            to_viser.write(head)
            ways = _copy(reader, to_viser), _copy(from_viser, writer)
            tasks = [asyncio.create_task(way) for way in ways]
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                task.cancel()


def _read_head(head: bytes) -> HTTPConnection:
    """Read the head of a request that uvicorn has checked."""
    first, *lines = head.removesuffix(END_OF_HEAD).split(b"\r\n")
    _, target, _ = first.split(b" ")
    pairs = (line.partition(b":") for line in lines)
    headers = [(name.lower(), value.strip(b" ")) for name, _, value in pairs]
    query = target.partition(b"?")[2]
    return HTTPConnection({"type": "websocket", "headers": headers, "query_string": query})


def _as_bytes(answer: Response) -> bytes:
    """Return an answer with which the connection ends, as HTTP."""
    first = f"HTTP/1.1 {answer.status_code} {HTTPStatus(answer.status_code).phrase}"
    own = [(name.encode(), value.encode()) for name, value in HEADERS]
    pairs = [*own, *answer.raw_headers, (b"Connection", b"close")]
    head = [first.encode(), *(b"%b: %b" % pair for pair in pairs)]
    return b"\r\n".join(head) + END_OF_HEAD + bytes(answer.body)


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copy what a connection sends until it ends, or until nobody takes it any more."""
    with suppress(OSError):
        while data := await reader.read(COPIED_MAX):
            writer.write(data)
            await writer.drain()


@contextmanager
def viser_at(path: str) -> Iterator[None]:
    """Let a viser server that starts in the `with` block listen on the Unix socket `path`.

    viser 1.1.1 opens a TCP port that answers everybody on this machine, and has no setting for
    this. Therefore the function with which viser opens its port is replaced.

    Raises:
        RuntimeError: If viser has not used the replaced function.
    """
    module, used = websockets.asyncio.server, list[str]()
    serve = module.serve

    def listen(handler: Any, _host: str, _port: int, **settings: Any) -> Any:
        used.append(path)
        return serve(handler, unix=True, path=path, **{**settings, "max_size": MESSAGE_MAX})

    module.serve = listen  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        module.serve = serve  # type: ignore[misc]
    if not used:
        raise RuntimeError("viser opens its port in another way: see cloudrc/doors/console/door.py")


def scene_page(viser: str, keys: Mapping[str, str]) -> str:
    """Return viser's page with STOP and keys, which do not wait for viser, and "loading".

    Args:
        viser: HTML of viser's page.
        keys: Key, as browsers name it -> label of the button that it holds.

    Raises:
        RuntimeError: If viser's page has changed.
    """
    style = _read("stop.css") + _read("scene.css")
    script = _read("stop.js") + _read("scene.js").replace("KEYS", json.dumps(keys))
    root, first = '<div id="root">', _read("stop.html") + _read("loading.html")
    parts = {
        "<title>Viser</title>": "<title>cloudrc</title>",
        "</head>": f"<style>{style}</style></head>",
        root: f"{first}<script>(() => {{{script}}})();</script>{root}",
    }
    for old, new in parts.items():
        if viser.count(old) != 1:
            raise RuntimeError(f"viser's page does not have {old} once: see console/door.py")
        viser = viser.replace(old, new)
    return viser


def plain_page(lines: list[str]) -> str:
    """Return the page without a scene: STOP, the state in `lines`, and buttons."""
    page = _read("plain.html")
    for name in ("stop.html", "stop.css", "stop.js", "plain.css", "plain.js"):
        page = page.replace(f"<!--{name}-->", _read(name)).replace(f"/*{name}*/", _read(name))
    return page.replace("<!--state-->", html.escape("\n".join(lines)))


def _read(name: str) -> str:
    return (WEB / name).read_text(encoding="utf-8")
