# SPDX-License-Identifier: Apache-2.0

"""A server that a test answers, and plain requests."""

import json
import threading
import urllib.error
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opener without a proxy: `urlopen` keeps the proxy that the environment named at first."""


def ask(request, limit=10.0):
    """Send a request, or get a URL; return status and text of the answer, also of an error."""
    try:
        answer = DIRECT.open(request, timeout=limit)
    except urllib.error.HTTPError as error:
        answer = error
    with answer:
        return answer.status, answer.read().decode()


def serve(answer):
    """Serve HTTP on a free port; `answer` gets the request and its JSON.

    It returns the status, a text or an object for JSON, and maybe further headers.
    """

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def reply(self):
            length = int(self.headers.get("Content-Length") or 0)
            given = json.loads(self.rfile.read(length)) if length else None
            code, said, *more = answer(self, given)
            is_text = isinstance(said, str)
            data = said.encode() if is_text else json.dumps(said).encode()
            kind = "text/plain" if is_text else "application/json"
            self.send_response(code)
            headers = {"Content-Type": kind, "Content-Length": str(len(data))}
            for name, value in {**headers, **dict(*more)}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)

        do_GET = do_POST = do_DELETE = reply  # noqa: N815

        def log_message(self, *words):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.url = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    return server
