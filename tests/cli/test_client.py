"""The client of the API, when another server answers, and over a socket file."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from cloudrc.cli.client import Api, ApiError


class Handler(BaseHTTPRequestHandler):
    """Answers with the HTTP status in the path, and with a body that teleop's API never sends."""

    def do_GET(self):
        self.send_response(int(self.path[1:]))
        self.send_header("Content-Length", "2")
        self.end_headers()
        self.wfile.write(b"[]")


def test_an_answer_of_another_server_is_shown_as_it_is():
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,)).start()
        for status in (307, 404, 503):
            with pytest.raises(ApiError, match=f"the API answered {status} "):
                Api(f"http://127.0.0.1:{server.server_port}").get(f"/{status}")
        server.shutdown()
