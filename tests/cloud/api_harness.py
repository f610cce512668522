"""The real API on a free port, over a service whose robot is flown by a thread of the test."""

import json
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager

from service_harness import ServiceFlight

from cloudrc import assembly
from cloudrc.cloud.teleop.api import Surroundings, create_app
from cloudrc.cloud.teleop.api_bridge import Bridge
from cloudrc.cloud.teleop.api_server import ApiServer
from cloudrc.geometry.scene import load_scene

LIMIT = 5.0


class Running:
    """API, service and robot; `flight.position` is where the robot is."""

    def __init__(self, *, ready=True):
        self.flight, self.bridge = ServiceFlight(), Bridge()
        surroundings = Surroundings(load_scene("pipes"), 60.0, True, assembly.mission_plan)
        self.server = ApiServer(
            create_app(self.bridge, surroundings), self.bridge, ("127.0.0.1", 0)
        )
        self.url = self.server.url
        self.server.start()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._fly)
        if ready:
            self.bridge.open(self.flight.teleop)
        self._thread.start()
        self.until(self.answers)

    def _fly(self):
        while not self._stopping.wait(0.002):
            for call in self.bridge.take():
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
        self._stopping.set()
        self._thread.join(LIMIT)

    def get(self, path):
        with urllib.request.urlopen(self.url + path, timeout=LIMIT) as answer:
            return json.loads(answer.read())

    def post(self, path, body=None):
        """Status and answer, whatever it is; `body` may be bytes."""
        data = (
            body if isinstance(body, bytes) else b"" if body is None else json.dumps(body).encode()
        )
        request = urllib.request.Request(self.url + path, data, method="POST")
        try:
            with urllib.request.urlopen(request, timeout=LIMIT) as answer:
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as error:
            return error.code, json.loads(error.read())

    def until(self, condition):
        limit = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < limit, "not in time"
            time.sleep(0.01)

    def state_of(self, mission_id):
        return self.get(f"/v1/missions/{mission_id}")["state"]


@contextmanager
def running(**options):
    one = Running(**options)
    try:
        yield one
    finally:
        one.stop()
