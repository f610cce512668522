"""The console answers its own page with its token, nobody else: over HTTP and by WebSocket."""

import base64
import socket

import pytest

from cloudrc.cli import console
from cloudrc.config.load import load_experiment
from cloudrc.console.access import Access, page_token
from cloudrc.console.feed import FlightFeed
from cloudrc.console.page import Page
from cloudrc.console.steering import Steering

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


def names(page):
    """Return the own host, and the line of the cookie with the token."""
    return f"127.0.0.1:{page.port}", f"Cookie: {page._access.cookie}={TOKEN}"


def foreign_origins(port):
    own = f"http://127.0.0.1:{port}"
    return [
        *("https://example.org", "null", "", f"https://127.0.0.1:{port}", "http://127.0.0.1"),
        *(f"{own}0", f"{own}/", f"{own},{own}", f"HTTP://127.0.0.1:{port}", f"{own}@example.org"),
        *(f"http://127.0.0.1.example.org:{port}", f"http://[::1]:{port}"),
        *(f"http://localhost:{port}", "http://hub.example.org", f"{PROXY}:443"),
        *("https://x.hub.example.org", "https://hub.example.org.evil.example"),
    ]


def foreign_hosts(port):
    return [
        *("example.org", "", f"127.0.0.1.:{port}", f"LOCALHOST:{port}", f"0.0.0.0:{port}"),
        *(f"127.0.0.1.example.org:{port}", f"127.0.0.1:{port}@example.org", "127.0.0.1:x"),
        *(f"127.0.0.1:{port},example.org", "hub.example.org:8000", "x.hub.example.org"),
    ]


WRONG_TOKENS = [
    *("", "x", TOKEN[:-1], f"{TOKEN}0", TOKEN.upper(), "0" * 12_000, f" {TOKEN}", f"{TOKEN}%20"),
    *(f"%30{TOKEN[1:]}", f"{TOKEN};", f"x&token={TOKEN}", f"{TOKEN}/", f"\xe9{TOKEN}"),
]


def test_the_own_page_connects_with_the_token(served):
    page, _ = served
    own, cookie = names(page)
    for host, origin in (
        (own, None),
        (own, f"http://{own}"),
        ("localhost:8000", "http://localhost:8000"),  # a tunnel
        ("127.0.0.1", "http://127.0.0.1"),
        ("hub.example.org", PROXY),
        ("hub.example.org", None),
        (own, PROXY),  # a proxy that changes the host
    ):
        lines = [f"Host: {host}", cookie, *([f"Origin: {origin}"] if origin else [])]
        assert both_doors(page, lines) == (200, 101), lines
        assert ask(page, lines[:1] + lines[2:], f"/?token={TOKEN}", upgrade=True)[0] == 101
    cookies = f"Cookie: theme=dark; {cookie.removeprefix('Cookie: ')}; cloudrc-0123=x"
    assert both_doors(page, [f"Host: {own}", cookies]) == (200, 101)


def test_no_foreign_origin_host_or_token_connects(served):
    """Each shape has everything right but the one."""
    page, _ = served
    own, cookie = names(page)
    host, origin = f"Host: {own}", f"Origin: http://{own}"
    shapes = [([host, cookie, f"Origin: {each}"], "") for each in foreign_origins(page.port)]
    shapes += [([f"Host: {each}", cookie], "") for each in foreign_hosts(page.port)]
    shapes += [([host, origin], f"?token={each}") for each in WRONG_TOKENS]
    name = page._access.cookie
    shapes += [
        ([host, origin, f"Cookie: {name}={each}"], "") for each in WRONG_TOKENS if each[-1:] != ";"
    ]
    shapes += [
        ([host, origin], ""),
        ([host, origin, f"Cookie: cloudrc-000000000000={TOKEN}"], ""),  # of another console
        ([host, origin, f"Cookie: token={TOKEN}; {name.upper()}={TOKEN}"], ""),
        ([host, origin, f"Cookie: {name}={TOKEN}; {name}=x"], ""),
        ([host, origin, f"Cookie: {name}={TOKEN}", f"Cookie: {name}=x"], ""),
        ([host, origin, f"Authorization: token {TOKEN}", f"X-Token: {TOKEN}"], ""),
        ([host, origin], f"?TOKEN={TOKEN}"),
        ([cookie, origin], ""),  # no host
        ([cookie, host, "Host: example.org"], ""),
        ([cookie, "Host: example.org", host], ""),
        ([cookie, host, origin, "Origin: https://example.org"], ""),
        ([cookie, host, "Origin: https://example.org", origin], ""),
        ([cookie, host, f"Origin: http://{own}", " https://example.org"], ""),  # folded
        ([cookie, "Host: example.org", f"X-Forwarded-Host: {own}", f"Forwarded: host={own}"], ""),
        ([cookie, "Host: hub.example.org", f"Origin: http://{own}"], ""),
    ]
    accepted = [shape for shape in shapes if {*both_doors(page, *shape)} & {101, 200, 202, 303}]
    assert not accepted


def test_a_foreign_page_cannot_stop_and_the_own_page_can(served):
    page, posted = served
    own, cookie = names(page)
    for lines in (
        [f"Host: {own}", cookie, "Origin: https://example.org"],
        [f"Host: {own}", f"Origin: http://{own}"],
        ["Host: example.org", cookie],
    ):
        assert ask(page, lines, "/stop", "POST")[0] == 403
        assert ask(page, lines, "/hold", "POST")[0] == 403
        assert ask(page, lines, "/state")[0] == 403
    assert ask(page, [f"Host: {own}", cookie], "/stop")[0] == 404, "no link stops"
    assert not page.steering._stops.is_set()
    assert ask(page, [f"Host: {own}", cookie, f"Origin: http://{own}"], "/stop", "POST")[0] == 202
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
    flags = {"config": secret, "profile": secret, "api": "http://127.0.0.1:1", "robot": None}
    options = type("Options", (), {**flags, "token_file": secret})
    assert console._in_pod(options).token() == page_token("o" * 32)
