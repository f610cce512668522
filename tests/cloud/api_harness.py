"""The real API on a free port, over a service whose robot is flown by a thread of the test."""

import json
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from service_harness import ServiceFlight

from cloudrc import assembly
from cloudrc.cli.client import Api
from cloudrc.geometry.scene import load_scene
from cloudrc.teleop.api import Surroundings, create_app
from cloudrc.teleop.auth import Audit, Tokens
from cloudrc.teleop.bridge import STARTING, Bridge
from cloudrc.teleop.server import ApiServer, Gate, Limits

DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Never by a proxy: `urlopen` keeps the one that was named when a process first called it."""
LIMIT = 5.0
OPERATOR, READER = "operator-token-of-the-tests", "reader-token-of-the-tests"
NO_LIMITS = Limits(1e6, 10**6, 10**6, 10**6)


class Running:
    """API, service and robot; `flight.position` is where the robot is."""

    def __init__(self, *, ready=True, limits=NO_LIMITS, unix=False):
        self.folder = TemporaryDirectory(prefix="cloudrc-")
        folder = Path(self.folder.name)
        (folder / "operator").write_text(OPERATOR + "\n")
        (folder / "reader").write_text(READER + "\n")
        self.flight, self.bridge = ServiceFlight(), Bridge()
        self.alarms, self.complaints = [], []
        self.bridge.alarm = lambda: self.alarms.append(time.monotonic())
        surroundings = Surroundings(load_scene("pipes"), 60.0, True, assembly.mission_plan)
        app, tokens = create_app(self.bridge, surroundings), Tokens(folder)
        self.audit = Audit(folder / "audit.jsonl", self.complaints.append)
        self.gate = Gate(app, None if unix else tokens, self.audit, limits, self.complaints.append)
        self.address = folder / "api.sock" if unix else ("127.0.0.1", 0)
        self.server = ApiServer(self.gate, self.bridge, self.address)
        self.token_file = folder / "operator"
        self.audit_file = folder / "audit.jsonl"
        self.url = self.server.url
        self.server.start()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._fly)
        if ready:
            self.bridge.open(self.flight.teleop)
        self._thread.start()
        if not unix:
            self.until(self.answers)

    def _fly(self):
        while not self._stopping.wait(0.002):
            for call in self.bridge.take() if self.bridge.closed != STARTING else ():
                call(self.flight.now_ns)
            self.flight.step()

    def answers(self):
        try:
            self.get("/v1/state")
        except urllib.error.HTTPError:
            return True
        except OSError:
            return False
        return True

    def stop(self):
        self.server.stop()
        self.audit.close()
        self._stopping.set()
        self._thread.join(LIMIT)
        self.folder.cleanup()

    def get(self, path):
        with DIRECT.open(self.request(path), timeout=LIMIT) as answer:
            return json.loads(answer.read())

    def request(self, path, data=None, token=OPERATOR, method=None, headers=None):
        headers = dict(headers or {})
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
        return urllib.request.Request(self.url + path, data, headers, method=method)

    def post(self, path, body=None, token=OPERATOR):
        """Status and answer, whatever it is; `body` may be bytes."""
        data = (
            body if isinstance(body, bytes) else b"" if body is None else json.dumps(body).encode()
        )
        return self.send(self.request(path, data, token, "POST"))

    def post_local(self, path, body=None):
        """Over the socket file."""
        return Api(self.url).post(path, body)

    def send(self, request):
        try:
            with DIRECT.open(request, timeout=LIMIT) as answer:
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read())

    def audited(self):
        """What the audit log has, once every request is done with; nothing is served after."""
        self.server.stop()
        self.audit.close()
        lines = self.audit_file.read_text().splitlines() if self.audit_file.exists() else []
        return [json.loads(line) for line in lines]

    def until(self, condition):
        limit = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < limit, "not in time"
            time.sleep(0.01)

    def state_of(self, mission_id):
        return self.get(f"/v1/missions/{mission_id}")["state"]


def connect(one):
    """A connection on which a test writes every byte itself."""
    host, _, port = one.url.removeprefix("http://").partition(":")
    return socket.create_connection((host, int(port)), timeout=10.0)


def head(method, path, *lines, token=OPERATOR):
    """The head of a request."""
    lines = (f"{method} {path} HTTP/1.1", "Host: x", f"Authorization: Bearer {token}", *lines)
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


@contextmanager
def running(**options):
    one = Running(**options)
    try:
        yield one
    finally:
        one.stop()
