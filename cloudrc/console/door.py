"""Listen at the console's address: check every request, switch the robot off, show the plain page.

The door has a thread of its own and does not draw, so that STOP never waits for the scene. It
passes the WebSockets of checked pages on to viser, up to `PAGES_MAX`.
"""

from __future__ import annotations

import asyncio
import errno
import html
import json
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.console.access import PARAMETER, Access, PageRequest, parse_head
from cloudrc.console.handed import HandedSockets
from cloudrc.errors import BadInputError, CloudrcError

PAGES_MAX = 50
"""Largest number of pages that have the scene; each further one gets the plain page."""
HEAD_MAX = 16_384
"""Size limit of a request's head [bytes]."""
HEAD_TIME = 10.0
"""Time limit for a browser to send a request and to take the answer [s]."""
LOOK_PERIOD = 0.02
"""Time between two looks at a request that has arrived in part [s]."""
WAITING_MAX = 512
"""Largest number of connections that wait for the door."""
NO_TOKEN = (
    "This address lacks the console's token, or has an old one. "
    "Open the address that 'cloudrc console' has printed."
)
FOREIGN = (
    "This address is not the console's own. If a proxy of yours serves it, "
    "start the console with --allow-origin and this origin."
)
WEB = Path(__file__).parent / "web"
"""Folder of the pages' parts."""


class PageAnswer(NamedTuple):
    """An HTTP answer."""

    status: HTTPStatus
    body: bytes = b""
    kind: str = "text/plain; charset=utf-8"
    headers: tuple[tuple[str, str], ...] = ()

    def encode(self) -> bytes:
        """Return the bytes to send."""
        lines = [f"HTTP/1.1 {self.status.value} {self.status.phrase}"]
        lines += [f"{name}: {value}" for name, value in self.headers]
        lines += [
            f"Content-Type: {self.kind}",
            f"Content-Length: {len(self.body)}",
            "Connection: close",
            "Cache-Control: no-store",
            "Referrer-Policy: no-referrer",
            "X-Content-Type-Options: nosniff",
            "X-Frame-Options: SAMEORIGIN",
        ]
        return "\r\n".join([*lines, "", ""]).encode("latin-1") + self.body


class Desk(NamedTuple):
    """What the door needs of the console; it calls these functions in its own threads."""

    stop: Callable[[], bool]  # switches the robot off, does not wait; False: not ready, ask again
    acts: Mapping[str, Callable[[], str]]  # name of a button -> act, returns the answer in words
    describe: Callable[[], list[str]]  # the state, line by line
    has_pilot: Callable[[], bool]  # whether a page with the scene steers


class Door:
    """The console's server at 127.0.0.1."""

    def __init__(self, port: int, access: Access, desk: Desk, scene: str) -> None:
        """Open the port (0: any free one); answer after `start`.

        Args:
            port: TCP port.
            access: Rules by which requests are refused.
            desk: Functions of the console.
            scene: HTML of the page with the scene.

        Raises:
            BadInputError: If the port cannot be opened.
        """
        try:
            self._socket = socket.create_server(("127.0.0.1", port), backlog=WAITING_MAX)
        except OSError as error:
            why = "is in use" if error.errno == errno.EADDRINUSE else str(error.strerror)
            raise BadInputError(f"--port {port}: {why}; name another port, or none") from None
        self._socket.setblocking(False)
        self.address: tuple[str, int] = self._socket.getsockname()
        self.pages = HandedSockets(self.address)
        self._access, self._desk = access, desk
        self._scene = scene
        self._open = 0  # connections that viser serves
        self._counting = threading.Lock()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="door", daemon=True)

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def close(self) -> None:
        """Stop to answer."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._work.cancel)
            self._thread.join()
        self._loop.close()
        self._socket.close()

    def count_out(self) -> None:
        """Count a page as ended that viser has served."""
        with self._counting:
            self._open -= 1

    def _count_in(self) -> bool:
        with self._counting:
            if self._open >= PAGES_MAX:
                return False
            self._open += 1
            return True

    def _run(self) -> None:
        self._work = self._loop.create_task(self._accept())
        with suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._work)
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(self._loop.shutdown_default_executor())

    async def _accept(self) -> None:
        tasks = set()
        while True:
            try:
                connection, _ = await self._loop.sock_accept(self._socket)
            except OSError:  # this process has no free file descriptor now
                await asyncio.sleep(LOOK_PERIOD)
                continue
            task = self._loop.create_task(self._serve(connection))
            tasks.add(task)
            task.add_done_callback(tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        """Answer one request, or pass its connection on to viser."""
        try:
            async with asyncio.timeout(HEAD_TIME):
                head = await self._look(connection)
                answer = await self._answer(head)
                if answer is None:
                    self.pages.hand(connection)
                    return
                await self._loop.sock_recv(connection, len(head) + 4)
                await self._loop.sock_sendall(connection, answer.encode())
                connection.shutdown(socket.SHUT_WR)
                while await self._loop.sock_recv(connection, HEAD_MAX):
                    pass  # what the browser still sends would reset the connection
        except (OSError, TimeoutError, asyncio.CancelledError):
            pass
        connection.close()

    async def _look(self, connection: socket.socket) -> bytes:
        """Return the head of the request (b"" if too long), and leave it in the socket, for viser.

        Raise a ConnectionError if the browser goes away before its end.
        """
        connection.setblocking(False)
        while True:
            await self._until_readable(connection)
            seen = connection.recv(HEAD_MAX, socket.MSG_PEEK)
            head, end, _ = seen.partition(b"\r\n\r\n")
            if end or len(seen) == HEAD_MAX:
                return head if end else b""
            if not seen:
                raise ConnectionResetError
            await asyncio.sleep(LOOK_PERIOD)  # the part of the request is readable all the time

    async def _until_readable(self, connection: socket.socket) -> None:
        readable = asyncio.Event()
        self._loop.add_reader(connection, readable.set)
        try:
            await readable.wait()
        finally:
            self._loop.remove_reader(connection)

    async def _answer(self, head: bytes) -> PageAnswer | None:
        """Answer a request; return None if viser shall."""
        try:
            request = parse_head(head)
        except ValueError:
            return PageAnswer(HTTPStatus.BAD_REQUEST)
        if not self._access.is_own_page(request):
            return PageAnswer(HTTPStatus.FORBIDDEN, FOREIGN.encode())
        try:
            if not self._access.has_token(request):
                return PageAnswer(HTTPStatus.FORBIDDEN, NO_TOKEN.encode())
        except CloudrcError as error:  # the file with the token cannot be read now
            return PageAnswer(HTTPStatus.SERVICE_UNAVAILABLE, str(error).encode())
        return await self._admit(request)

    async def _admit(self, request: PageRequest) -> PageAnswer | None:
        """Answer a checked request; return None if viser shall."""
        if request.method == "POST":
            return await self._act(request.path.removeprefix("/"))
        if request.method != "GET":
            return PageAnswer(HTTPStatus.METHOD_NOT_ALLOWED)
        if request.is_websocket:
            is_free = self._count_in()
            return None if is_free else PageAnswer(HTTPStatus.SERVICE_UNAVAILABLE)
        if self._access.given_tokens(request):
            return self._keep_token(request)
        return self._page(request.path)

    def _keep_token(self, request: PageRequest) -> PageAnswer:
        """Move the token from the address to a cookie.

        The cookie has no path: the browser takes that of the page, also behind a proxy.
        """
        parts = [p for p in request.query.split("&") if p.partition("=")[0] != PARAMETER]
        name = request.path.rpartition("/")[2]
        target = f"./{name}" + (f"?{'&'.join(parts)}" if parts else "")
        cookie = f"{self._access.cookie}={self._access.token()}; HttpOnly; SameSite=Lax"
        headers = (("Location", target), ("Set-Cookie", cookie))
        return PageAnswer(HTTPStatus.SEE_OTHER, headers=headers)

    def _page(self, path: str) -> PageAnswer:
        if path == "/state":
            return PageAnswer(HTTPStatus.OK, json.dumps(self._state()).encode(), "application/json")
        if path == "/plain" or (path == "/" and self._open >= PAGES_MAX):
            text = plain_page(self._state()["lines"])
        elif path == "/":
            text = self._scene
        else:
            return PageAnswer(HTTPStatus.NOT_FOUND)
        return PageAnswer(HTTPStatus.OK, text.encode(), "text/html; charset=utf-8")

    def _state(self) -> dict[str, Any]:
        """Return the state, the buttons of the plain page, and whether all scenes are taken."""
        is_read_only = self._desk.has_pilot()
        lines = ["Read only: another browser steers."] if is_read_only else []
        acts = [] if is_read_only else list(self._desk.acts)
        lines += self._desk.describe()
        return {"lines": lines, "acts": acts, "is_full": self._open >= PAGES_MAX}

    async def _act(self, name: str) -> PageAnswer:
        """Carry out what a page asks for."""
        if name == "stop":
            if self._desk.stop():
                return PageAnswer(HTTPStatus.ACCEPTED, b"switching the robot off")
            return PageAnswer(HTTPStatus.SERVICE_UNAVAILABLE, b"the console starts; ask again")
        if (act := self._desk.acts.get(name)) is None:
            return PageAnswer(HTTPStatus.NOT_FOUND)
        if self._desk.has_pilot():
            return PageAnswer(HTTPStatus.CONFLICT, b"another browser steers")
        return PageAnswer(HTTPStatus.OK, (await asyncio.to_thread(act)).encode())


def scene_page(viser: str, keys: Mapping[str, str]) -> str:
    """Return viser's page with STOP and keys, which do not wait for viser.

    Args:
        viser: HTML of viser's page.
        keys: Key, as browsers name it -> label of the button that it holds.

    Raises:
        RuntimeError: If viser's page has changed.
    """
    style = _read("stop.css") + _read("scene.css")
    script = _read("stop.js") + _read("scene.js").replace("KEYS", json.dumps(keys))
    root = '<div id="root">'
    parts = {
        "<title>Viser</title>": "<title>cloudrc</title>",
        "</head>": f"<style>{style}</style></head>",
        root: f"{_read('stop.html')}<script>(() => {{{script}}})();</script>{root}",
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
