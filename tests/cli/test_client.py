"""The client of the API, when another server answers."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from cloudrc.cli.client import Api, ApiError
from tests.teleop.conftest import running


class Handler(BaseHTTPRequestHandler):
    """Answers with the HTTP status in the path, and with a body that teleop's API never sends."""

    def do_GET(self):
        self.send_response(int(self.path[1:]))
        self.send_header("Content-Length", "2")
        self.end_headers()
        self.wfile.write(b"[]")

    def log_message(self, *args):
        """Log nothing."""


@pytest.fixture
def url():
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("status", [307, 404, 418, 503])
def test_an_answer_of_another_server_is_shown_as_it_is(url, status):
    with pytest.raises(ApiError, match=f"the API answered {status} "):
        Api(url).get(f"/{status}")


@pytest.mark.parametrize("name", ["a b", "a:80", "a:b", "[::", "ü" * 8])
def test_a_socket_may_have_any_path(name, tmp_path):
    with running(unix=True) as api:
        path = tmp_path / name
        path.symlink_to(api.url.removeprefix("unix:"))
        assert Api(f"unix:{path}").get("/v1/missions") == {"missions": []}
