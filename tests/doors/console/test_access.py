# SPDX-License-Identifier: Apache-2.0

"""The console answers its own page with its token, nobody else: over HTTP and by WebSocket."""

import base64
import socket

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.doors.console.access import Access, page_token
from cloudrc.doors.console.feed import FlightFeed
from cloudrc.doors.console.page import Page
from cloudrc.doors.console.steering import Steering
from tests.doors.console.conftest import in_pod

TOKEN = "0123456789abcdef" * 2
PROXY = "https://hub.example.org"


@pytest.fixture(scope="module")
def served():
    """A page with a token, behind a proxy or not; and an API that notes what it is asked for."""
    posted = []

    class Api:
        def post(self, path, body=None):
            posted.append(path)

    flight = load_experiment("hover"), FlightFeed(), Steering(Api())
    page = Page(*flight, 0, lambda: TOKEN, [PROXY])
    yield page, posted
    page.close()


def ask(page, lines, target="/", method="GET", *, upgrade=False):
    """Send a request with these header lines; return the status of the answer and its head."""
    head = [f"{method} {target} HTTP/1.1", *lines]
    if upgrade:
        key = base64.b64encode(bytes(16)).decode()
        head += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        head += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Protocol: viser-v1.1.1"]
    with socket.create_connection(("127.0.0.1", page.port), 10) as connection:
        connection.sendall(("\r\n".join(head) + "\r\n\r\n").encode("latin-1"))
        said = connection.recv(65_536).decode("latin-1")
    return int(said.split(" ")[1]), said.partition("\r\n\r\n")[0]


def both_doors(page, lines, query=""):
    """Return the statuses of the two doors: the page over HTTP, and its WebSocket."""
    target = f"/{query}"
    return ask(page, lines, target)[0], ask(page, lines, target, upgrade=True)[0]


def filled(page, text):
    """Return the header lines of a text that has | between them."""
    own = f"127.0.0.1:{page.port}"
    for word, value in (("OWN", own), ("PORT", str(page.port)), ("NAME", page._access.cookie)):
        text = text.replace(word, value)
    return text.replace("TOKEN", TOKEN).split(" | ")


OWN_PAGE = """
Host: OWN
Host: OWN | Origin: http://OWN
Host: localhost:8000 | Origin: http://localhost:8000
Host: 127.0.0.1 | Origin: http://127.0.0.1
Host: hub.example.org | Origin: https://hub.example.org
Host: hub.example.org
Host: OWN | Origin: https://hub.example.org
"""
"""Directly, through a tunnel, and behind a proxy, which may change the host."""
FOREIGN = """
Host: OWN | Cookie: NAME=TOKEN | Origin: https://example.org
Host: OWN | Cookie: NAME=TOKEN | Origin: null
Host: OWN | Cookie: NAME=TOKEN | Origin:
Host: OWN | Cookie: NAME=TOKEN | Origin: https://OWN
Host: OWN | Cookie: NAME=TOKEN | Origin: http://127.0.0.1
Host: OWN | Cookie: NAME=TOKEN | Origin: http://OWN0
Host: OWN | Cookie: NAME=TOKEN | Origin: http://OWN/
Host: OWN | Cookie: NAME=TOKEN | Origin: http://OWN,http://OWN
Host: OWN | Cookie: NAME=TOKEN | Origin: HTTP://OWN
Host: OWN | Cookie: NAME=TOKEN | Origin: http://OWN@example.org
Host: OWN | Cookie: NAME=TOKEN | Origin: http://127.0.0.1.example.org:PORT
Host: OWN | Cookie: NAME=TOKEN | Origin: http://[::1]:PORT
Host: OWN | Cookie: NAME=TOKEN | Origin: http://localhost:PORT
Host: OWN | Cookie: NAME=TOKEN | Origin: http://hub.example.org
Host: OWN | Cookie: NAME=TOKEN | Origin: https://hub.example.org:443
Host: OWN | Cookie: NAME=TOKEN | Origin: https://x.hub.example.org
Host: OWN | Cookie: NAME=TOKEN | Origin: https://hub.example.org.evil.example
Host: OWN | Cookie: NAME=TOKEN | Origin: http://OWN | Origin: https://example.org
Host: OWN | Cookie: NAME=TOKEN | Origin: https://example.org | Origin: http://OWN
Host: OWN | Cookie: NAME=TOKEN | Origin: http://OWN |  https://example.org
Host: example.org | Cookie: NAME=TOKEN
Host: | Cookie: NAME=TOKEN
Host: 127.0.0.1.:PORT | Cookie: NAME=TOKEN
Host: LOCALHOST:PORT | Cookie: NAME=TOKEN
Host: 0.0.0.0:PORT | Cookie: NAME=TOKEN
Host: 127.0.0.1.example.org:PORT | Cookie: NAME=TOKEN
Host: OWN@example.org | Cookie: NAME=TOKEN
Host: 127.0.0.1:x | Cookie: NAME=TOKEN
Host: OWN,example.org | Cookie: NAME=TOKEN
Host: hub.example.org:8000 | Cookie: NAME=TOKEN
Host: x.hub.example.org | Cookie: NAME=TOKEN
Host: hub.example.org | Cookie: NAME=TOKEN | Origin: http://OWN
Host: OWN | Cookie: NAME=TOKEN | Host: example.org
Host: example.org | Cookie: NAME=TOKEN | Host: OWN
Host: example.org | Cookie: NAME=TOKEN | X-Forwarded-Host: OWN | Forwarded: host=OWN
Cookie: NAME=TOKEN | Origin: http://OWN
Host: OWN | Origin: http://OWN
Host: OWN | Origin: http://OWN | Cookie: cloudrc-000000000000=TOKEN
Host: OWN | Origin: http://OWN | Cookie: NAME=TOKEN; NAME=x
Host: OWN | Origin: http://OWN | Cookie: NAME=TOKEN | Cookie: NAME=x
Host: OWN | Origin: http://OWN | Authorization: token TOKEN | X-Token: TOKEN
"""
"""Each has everything right but the origin, the host or the token. One has the cookie of another
console; in one the origin is folded."""
WRONG_TOKENS = [
    *("", "x", TOKEN[:-1], f"{TOKEN}0", TOKEN.upper(), "0" * 12_000, f" {TOKEN}", f"{TOKEN}%20"),
    *(f"%30{TOKEN[1:]}", f"{TOKEN};", f"x&token={TOKEN}", f"{TOKEN}/", f"\xe9{TOKEN}"),
]


def test_the_own_page_connects_with_the_token(served):
    page, _ = served
    for text in OWN_PAGE.splitlines()[1:]:
        lines = filled(page, f"{text} | Cookie: NAME=TOKEN")
        assert both_doors(page, lines) == (200, 101), lines
        assert ask(page, lines[:-1], f"/?token={TOKEN}", upgrade=True)[0] == 101
    cookies = "Host: OWN | Cookie: theme=dark; NAME=TOKEN; cloudrc-0123=x"
    assert both_doors(page, filled(page, cookies)) == (200, 101)


def test_no_foreign_origin_host_or_token_connects(served):
    page, _ = served
    own, name = filled(page, "Host: OWN | Origin: http://OWN"), page._access.cookie
    shapes = [(filled(page, text), "") for text in FOREIGN.splitlines()[1:]]
    shapes += [(own, f"?token={each}") for each in WRONG_TOKENS]
    cookies = [each for each in WRONG_TOKENS if each[-1:] != ";"]
    shapes += [([*own, f"Cookie: {name}={each}"], "") for each in cookies]
    shapes += [([*own, f"Cookie: token={TOKEN}; {name.upper()}={TOKEN}"], "")]
    shapes += [(own, f"?TOKEN={TOKEN}")]
    accepted = [shape for shape in shapes if {*both_doors(page, *shape)} & {101, 200, 202, 303}]
    assert not accepted


def test_a_foreign_page_cannot_stop_and_the_own_page_can(served):
    page, posted = served
    for text in (
        "Host: OWN | Cookie: NAME=TOKEN | Origin: https://example.org",
        "Host: OWN | Origin: http://OWN",
        "Host: example.org | Cookie: NAME=TOKEN",
    ):
        lines = filled(page, text)
        assert ask(page, lines, "/stop", "POST")[0] == 403
        assert ask(page, lines, "/hold", "POST")[0] == 403
        assert ask(page, lines, "/state")[0] == 403
    own = filled(page, "Host: OWN | Cookie: NAME=TOKEN | Origin: http://OWN")
    assert ask(page, own[:2], "/stop")[0] == 404, "no link stops"
    assert not page.steering._stops.is_set()
    assert ask(page, own, "/stop", "POST")[0] == 202
    assert page.steering._stops.is_set()
    assert posted == []  # the thread that asks the API does not run here


def test_the_token_moves_from_the_address_to_a_cookie_of_this_console(served):
    page, _ = served
    host = f"Host: 127.0.0.1:{page.port}"
    status, head = ask(page, [host], f"/?fixedDpr=0.25&token={TOKEN}")
    assert status == 303
    assert "location: ./?fixedDpr=0.25\r\n" in head
    assert f"set-cookie: {page._access.cookie}={TOKEN}; HttpOnly; SameSite=lax" in head
    assert "path=" not in head.lower(), "behind a proxy, the browser takes the path of the page"
    assert Access(lambda: TOKEN[::-1]).cookie != page._access.cookie


def test_the_token_of_a_release_s_page_follows_from_that_of_its_api(tmp_path):
    secret = tmp_path / "operator"
    secret.write_text("o" * 32)
    assert page_token("o" * 32) != page_token("p" * 32)
    assert "o" * 8 not in page_token("o" * 32)
    assert in_pod(secret, token_file=secret).token() == page_token("o" * 32)
