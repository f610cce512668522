"""The API behind a proxy, or another program at its address: it works, or one line says why not."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from cloudrc.teleop.client import Api, ApiError, UnreachableError

STATE = "/v1/state"


@pytest.fixture
def proxy():
    """Serve `answers`: path -> status, content type, content, other headers; else 404."""
    answers = {}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            status, kind, content, headers = answers.get(
                self.path, (404, "application/json", '{"detail": "Not Found"}', {})
            )
            self.send_response(status)
            for name, value in {"Content-Type": kind, **headers}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content.encode())

        def log_message(self, *given):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield answers, f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_an_api_behind_the_path_of_a_proxy_is_reached(proxy):
    answers, url = proxy
    answers["/robots/7" + STATE] = 200, "application/json", json.dumps({"mission": None}), {}
    assert Api(f"{url}/robots/7/").get(STATE) == {"mission": None}
    with pytest.raises(ApiError, match=r"404 Not Found: a proxy or another"):
        Api(f"{url}/robots").get(STATE)


PAGE = "<!DOCTYPE html><title>Please log in</title>"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ((200, "text/html; charset=utf-8", PAGE, {}), "200 OK: a proxy or"),
        ((302, "text/html", "", {"Location": "https://sso/x"}), "302 Found: a proxy or"),
    ],
)
def test_another_program_at_the_address_is_told_in_one_line(proxy, answer, said):
    answers, url = proxy
    answers[STATE] = answer
    with pytest.raises(ApiError, match=rf"^[^\n]*{said}[^\n]*$") as told:
        Api(url).get(STATE)
    assert not isinstance(told.value, UnreachableError), "nobody waits for it"


def test_a_proxy_whose_server_is_away_is_worth_waiting_for(proxy):
    answers, url = proxy
    answers[STATE] = 502, "text/html", PAGE, {}
    with pytest.raises(UnreachableError, match="the API answered 502 Bad Gateway"):
        Api(url).get(STATE)
