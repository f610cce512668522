# SPDX-License-Identifier: Apache-2.0

"""The door answers without viser: STOP, the plain page, and what a browser may send."""

import json
import socket
import threading
import time
from contextlib import ExitStack
from urllib.request import Request

import pytest
import viser
import websockets.asyncio.server
from starlette.responses import HTMLResponse
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from cloudrc.config.load import load_experiment
from cloudrc.doors.console import door
from cloudrc.doors.console.door import scene_page, viser_at
from cloudrc.doors.console.feed import FlightFeed
from cloudrc.doors.console.page import Page
from cloudrc.doors.console.steering import Steering
from cloudrc.wire.messages import ZERO
from tests.conftest import wait_until
from tests.doors.console.conftest import LIMIT
from tests.support.http import ask

VERSION = f"viser-v{viser.__version__}"


@pytest.fixture
def page(api):
    api.answers["/v1/state"] = {"mission": None, "seen": None}
    steering = Steering(api)
    steering.watch()
    page = Page(load_experiment("hover"), FlightFeed(), steering)
    yield page
    page.close()


def call(page, path, method="GET"):
    """Send a request with the token in the cookie; return status and body."""
    headers = {"Cookie": f"{page._access.cookie}={page._access.token()}"}
    url = f"http://127.0.0.1:{page.port}/{path}"
    return ask(Request(url, method=method, headers=headers))


def scene(page):
    """Open the WebSocket of a page with the scene."""
    url = page.url.replace("http://", "ws://")
    return connect(url, subprotocols=[VERSION], max_size=None, compression=None, proxy=None)


def test_stop_does_not_wait_for_viser(page):
    """viser's loop stands still, as if it drew for many pages."""
    over = threading.Event()
    page._server.get_event_loop().call_soon_threadsafe(over.wait)
    try:
        assert call(page, "stop", "POST")[0] == 202
        assert page.steering._stops.is_set()
        assert call(page, "plain")[0] == 200
        assert '<form id="stop"' in call(page, "")[1], "the page with the scene has STOP itself"
    finally:
        over.set()


def test_stop_does_not_wait_for_a_request_without_an_end(page):
    with ExitStack() as stack:
        for _ in range(100):
            other = socket.create_connection(("127.0.0.1", page.port))
            stack.enter_context(other).sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1")
        began = time.monotonic()
        assert call(page, "stop", "POST")[0] == 202
        assert time.monotonic() - began < 2.0


def test_a_request_without_an_end_is_ended(page, monkeypatch):
    monkeypatch.setattr(door, "HEAD_TIME", 0.1)
    with socket.create_connection(("127.0.0.1", page.port), 10) as other:
        other.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1")
        assert other.recv(100) == b""
    with socket.create_connection(("127.0.0.1", page.port), 10) as other:
        other.sendall(b"GET / HTTP/1.1\r\nA: " + b"a" * door.HEAD_MAX)
        assert b" 400 " in other.recv(100)


def test_the_plain_page_shows_the_state_and_its_buttons_act(page, api):
    assert "no telemetry from the robot yet" in call(page, "plain")[1]
    state = json.loads(call(page, "state")[1])
    assert state["acts"] == ["start", "hold", "resume", "cancel", "acknowledge"]
    assert call(page, "hold", "POST") == (200, "holding")
    assert api.posted == [("/v1/hold", None)]
    api.refused["/v1/resume"] = "nothing is held"
    assert call(page, "resume", "POST") == (200, "not done: nothing is held")
    assert call(page, "fly", "POST")[0] == 404
    page.pilot = 0  # a page with the scene steers
    assert call(page, "hold", "POST")[0] == 409
    state = json.loads(call(page, "state")[1])
    assert (state["acts"], state["lines"][0][:9]) == ([], "Read only")
    assert call(page, "stop", "POST")[0] == 202


def test_some_pages_have_the_scene_and_every_further_one_the_plain_page(page, monkeypatch):
    monkeypatch.setattr(door, "PAGES_MAX", 2)
    with scene(page) as first:
        with scene(page):
            assert 'id="acts"' in call(page, "")[1]
            with pytest.raises(InvalidStatus, match="503"):
                scene(page)
            assert call(page, "stop", "POST")[0] == 202
        wait_until(lambda: "root" in call(page, "")[1])
        with scene(page) as second:
            assert first.recv()
            assert second.recv()


@pytest.mark.process
def test_a_page_without_a_place_and_one_without_webgl_become_plain(page, browse, monkeypatch):
    def take_all_places(text):
        page._door._open = door.PAGES_MAX
        return HTMLResponse(text)

    monkeypatch.setattr(door, "HTMLResponse", take_all_places)
    late = browse(page.url)
    late.get_by_role("button", name="Hold", exact=True).wait_for(timeout=LIMIT * 1e3)
    assert late.url.endswith("/plain")
    late.keyboard.press("Shift+X")
    wait_until(page.steering._stops.is_set)
    page.steering._stops.clear()
    page._door._open = 0
    late.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    late.goto(page.url)
    late.get_by_role("button", name="STOP", exact=True).click()
    wait_until(page.steering._stops.is_set)
    late.wait_for_url("**/plain")


WATCH = """
const find = name => [...document.querySelectorAll('button')].find(one => one.innerText === name);
const look = () => {
  const middle = document.elementFromPoint(innerWidth / 2, innerHeight / 2);
  if (find('STOP')) {
    window.seen ??= new Set();
    window.seen.add(middle.id === 'loading' ? 'loading' : find('Hold') ? 'ready' : 'viser');
  }
  requestAnimationFrame(look);
};
look();
"""
"""Notes for each frame of a page what it shows."""


@pytest.mark.process
def test_a_slow_browser_says_loading_and_never_shows_the_panel_of_viser(page, browse):
    opened = browse(page.url.replace("/?", "/plain?"))
    opened.set_default_timeout(LIMIT * 1e3)
    opened.context.new_cdp_session(opened).send("Emulation.setCPUThrottlingRate", {"rate": 6})
    opened.add_init_script(WATCH)
    opened.goto(f"{page.url}&fixedDpr=0.25", wait_until="commit")
    opened.wait_for_function("window.seen?.has('ready')")
    assert opened.evaluate("[...window.seen]") == ["loading", "ready"]


@pytest.mark.process
@pytest.mark.parametrize(
    ("key", "code"), [("X", "KeyX"), ("x", "KeyX"), ("X", "KeyB"), ("Q", "KeyX"), ("Ч", "KeyX")]
)
def test_shift_and_x_stops_by_letter_or_by_place(page, browse, key, code):
    """On a US keyboard, with Caps Lock, by Dvorak's letter and place, and on a Cyrillic one."""
    opened = browse(page.url.replace("/?", "/plain?"))
    script = "names => document.body.dispatchEvent(new KeyboardEvent('keydown', names))"
    names = {"key": key, "code": code, "bubbles": True, "cancelable": True}
    opened.evaluate(script, names)
    opened.evaluate(script, {**names, "shiftKey": True, "key": "y", "code": "KeyY"})
    assert not page.steering._stops.is_set()
    opened.evaluate(script, {**names, "shiftKey": True})
    wait_until(page.steering._stops.is_set)


@pytest.mark.process
def test_held_keys_count_as_released_when_meta_changes_at_blur_and_when_hidden(page, browse):
    """macOS tells no release of a key while Command is held, a page without focus none at all."""
    opened = browse(f"{page.url}&fixedDpr=0.25")
    opened.get_by_role("button", name="Hold", exact=True).wait_for(timeout=LIMIT * 1e3)
    keys = opened.keyboard

    def speed():
        return page.steering.velocity(time.monotonic())

    for change in (
        lambda: (keys.down("Meta"), keys.up("Meta")),
        lambda: opened.evaluate("dispatchEvent(new Event('blur'))"),
        lambda: opened.evaluate("document.dispatchEvent(new Event('visibilitychange'))"),
    ):
        keys.down("ArrowUp")
        wait_until(lambda: speed() != ZERO)
        change()
        wait_until(lambda: speed() == ZERO, limit=30.0)
        keys.down("ArrowUp")  # the keyboard repeats the key, which is still down
        time.sleep(0.5)
        assert speed() == ZERO
        keys.up("ArrowUp")


def test_viser_listens_on_the_socket_alone(tmp_path):
    """If a new viser opens its port in another way, its port would be open to everybody."""
    serve, path = websockets.asyncio.server.serve, tmp_path / "viser.sock"
    with viser_at(str(path)):
        server = viser.ViserServer(verbose=False)
    assert path.is_socket()
    assert not isinstance(server.get_port(), int), "it has opened no port"
    server.stop()
    assert websockets.asyncio.server.serve is serve
    with (
        pytest.raises(RuntimeError, match=r"see .*console/door\.py"),
        viser_at(str(path)),
    ):
        pass
    with pytest.raises(RuntimeError, match="viser's page"):
        scene_page("<html></html>", {})
