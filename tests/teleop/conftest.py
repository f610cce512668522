# SPDX-License-Identifier: Apache-2.0

"""A robot and a lossy link for teleop, a store that may fail, and the real API on a free port."""

import json
import socket
import sqlite3
import threading
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.request import Request as HttpRequest

import pytest

from cloudrc.base.outside.reuse import reuse_results
from cloudrc.cloud.operator import EmergencyStopRepeater
from cloudrc.config.load import read_experiment
from cloudrc.config.world import ResolvedWorld
from cloudrc.flight.assembly.plan import build_plan
from cloudrc.physics.geometry.scene import load_scene
from cloudrc.teleop import store
from cloudrc.teleop.api import STARTING, ApiServer, Bridge, create_app
from cloudrc.teleop.auth import Gate, Tokens
from cloudrc.teleop.carrot import setpoint_at
from cloudrc.teleop.models import RequestReader
from cloudrc.teleop.refusals import ConflictError, UnavailableError
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import MissionStore, Order
from cloudrc.teleop.wire import ALARM, Leg, Plan, RobotStatus
from cloudrc.wire.messages import (
    UPRIGHT,
    Cause,
    GuardState,
    OperatorRequest,
    Request,
    Setpoint,
    Start,
)
from cloudrc.wire.records import Fault, MissionEvent
from tests.conftest import wait_until
from tests.fences import FENCE
from tests.support.http import ask

PERIOD_NS = 10_000_000
PELICAN, PAPER = ResolvedWorld(robot="pelican").files.hull, read_experiment("paper")
A, B, C = (1.0, 0.0, 1.0), (2.0, 0.0, 1.0), (3.0, 0.0, 1.0)
AWAY = (0.0, -5.0, 1.0)
ID = 7
UNITS = {"battery": "V", "range": "m"}
THREE = Plan((Leg(A, dwell=0.0), Leg(B, dwell=0.0), Leg(C, dwell=0.0)), Start.HERE)
FROM_SPAWN = Plan(THREE.legs)
PLAN = Plan((Leg(A, yaw=0.3, yaw_tolerance=1.0), Leg(B, tolerance=0.2, dwell=0.0), Leg(C)))


class KilledError(BaseException):
    """The process is gone."""


class Disk(sqlite3.Connection):
    """The database of a `ServiceFlight`, whose commits may fail, or be the last of the process."""

    flight = None

    def commit(self):
        self.flight.commits += 1
        if self.flight.killed_before == self.flight.commits:
            raise KilledError
        if self.flight.full:
            raise sqlite3.OperationalError("database or disk is full")
        super().commit()
        self.flight.image = self.serialize()
        if self.flight.killed_after == self.flight.commits:
            raise KilledError


class ServiceFlight:
    """A mission service, which can be restarted, its robot, and all that the service says."""

    def __init__(self, scene=None, **how):
        self.scene, self.full, self.mark, self.how = scene, False, 0, how
        self.image, self.commits = None, 0  # the disk after the last commit; attempts to commit
        self.now_ns, self.position = 0, (0.0, 0.0, 0.1)
        self.epoch, self.world, self.mission = 1, "world 1", 0
        self.onboard = (0, 0)  # mission's number and waypoints reached, as world keeps them
        self.guard, self.cause = GuardState.GROUND, Cause.SPAWN
        self.obstacle_contacts, self.touch_speed, self.slip_ns = 0, float("nan"), 0
        self.sensors, self.orientation = (), UPRIGHT
        self.uplink = self.downlink = True
        self.said = []
        self.stop = EmergencyStopRepeater()  # cloud's
        self.restart_teleop()

    def restart_teleop(self):
        """Start a new service with the missions on the disk."""
        self.killed_before = self.killed_after = None  # number of a commit
        self.teleop = MissionService(self.stored(), FENCE, self.scene, PELICAN, UNITS, **self.how)

    def stored(self):
        """Return the store that a new process reads from the disk."""
        disk = store.connect(None, Disk)
        disk.flight = self
        if self.image is not None:
            disk.deserialize(self.image)
        return MissionStore(disk, b"")

    @property
    def kept(self):
        """Events that the disk has, oldest first."""
        return self.stored().events_after(0)

    def create(self, plan=FROM_SPAWN, **order):
        mission, _ = self.teleop.create(Order(plan, **order), self.now_ns)
        self.collect()
        return mission.id

    @property
    def newest(self):
        """The mission that was created last; None before the first."""
        return next(reversed(self.teleop.book.missions.values()), None)

    def view(self, mission_id):
        return self.teleop.book.find(mission_id).as_json()

    def names(self, mission_id):
        return [event["event"] for event in self.view(mission_id)["events"]]

    def step(self, position=None, seconds=0.01):
        """Let time pass in periods of 10 ms, telemetry and deadline in each."""
        if position is not None:  # else a test may set it at the same time, from its thread
            self.position = position
        for _ in range(round(seconds * 100)):
            self.now_ns += PERIOD_NS
            if self.uplink:
                self.stop.see(self.guard, self.mission)
                self.see()
            self.teleop.handle_deadline(self.now_ns)
            self.collect()
            stop = self.stop.due(self.mission, self.now_ns) if self.stop.sounds else None
            if stop is not None and self.downlink:
                self._obey(stop)

    @property
    def seen(self):
        return RobotStatus(
            *(self.epoch, self.position, self.guard, self.mission, self.world),
            *(self.obstacle_contacts, self.touch_speed, self.slip_ns),
            mission_id=self.onboard[0], reached=self.onboard[1], cause=self.cause,
            sensors=self.sensors, orientation_wxyz=self.orientation,
        )  # fmt: skip

    def see(self):
        self.teleop.see(self.seen, self.now_ns)

    def restart(self):
        """World loses everything it knew."""
        self.epoch += 1
        self.world, self.mission, self.onboard = f"world {self.epoch}", 0, (0, 0)
        self.guard, self.position = GuardState.GROUND, (0.0, 0.0, 0.1)

    def restart_cloud(self):
        """A new cloud opens a new epoch in the same world, and counts requests from 1 again."""
        self.epoch += 1
        self.mission, self.guard = 0, GuardState.HOLD
        self.stop = EmergencyStopRepeater()

    def _of(self, kind):
        return [said for said in self.said if isinstance(said, kind)]

    @property
    def requests(self):
        return self._of(OperatorRequest)

    @property
    def events(self):
        return self._of(MissionEvent)

    @property
    def setpoints(self):
        return self._of(Setpoint)

    @property
    def faults(self):
        return self._of(Fault)

    def collect(self):
        for output in self.teleop.take_outputs():
            for_session = isinstance(output, Setpoint | OperatorRequest)
            said = output._replace(epoch=0) if for_session else output
            self.said.append(said)
            if said == ALARM:
                self.stop.sound()
            elif isinstance(said, OperatorRequest):
                if said.request is Request.ACKNOWLEDGE:
                    self.stop.acknowledge()
                if self.downlink:
                    self._obey(said)

    def _obey(self, request):
        """Act on it as world does: rising numbers only; a start from the spawn restarts."""
        if request.request is Request.PROGRESS:
            self._keep(request)
        if request.number <= self.mission:
            return
        self.mission = request.number
        stopped = self.guard in (GuardState.LAND, GuardState.ESTOP)
        if request.request is Request.ESTOP:
            self.guard, self.cause = GuardState.ESTOP, Cause.STOPPED
        elif request.request is Request.ACKNOWLEDGE:
            self.guard = GuardState.GROUND if stopped else self.guard
        elif request.request is Request.START:
            if request.mission_id != self.onboard[0] or request.start is Start.SPAWN:
                self.onboard = (request.mission_id, 0)
            self._keep(request)
            if request.start is Start.SPAWN:
                self.epoch += 1
                self.position = (0.0, 0.0, 0.1)
            if not stopped:
                self.guard, self.cause = GuardState.TRACK, Cause.COMMAND
        elif not stopped:
            self.guard = GuardState.HOLD

    def _keep(self, request):
        number, reached = self.onboard
        if request.mission_id == number:
            self.onboard = (number, max(reached, request.reached))


def flying(plan=FROM_SPAWN, **order):
    """A flight whose mission, m1, has just started."""
    flight = ServiceFlight()
    flight.step()
    flight.create(plan, **order)
    flight.step(seconds=0.05)
    assert flight.newest.state == "flying"
    return flight


def service_flying(**order):
    """A flight on its way to the second waypoint, and the id of its mission."""
    flight = flying(**order)
    flight.step(position=A)
    assert flight.newest.waypoint == 1
    return flight, "m1"


def reference(flight):
    """Return the setpoint as it is now."""
    return setpoint_at(flight.setpoints[-1], flight.now_ns)


PLACES = {"A": A, "B": B, "C": C, "away": AWAY, "near": (1.07, 0.07, 1.07)}
ORDERS = {
    **{"create": {}, "queue": {"queue": True}, "here": {"plan": THREE}, "patient": {"plan": PLAN}},
    **{"leased": {"lease": 10.0}, "waiting": {"lease": 10.0, "queue": True}},
}
SWITCHES = {
    **{guard.name: {"guard": guard} for guard in GuardState},
    **{"full": {"full": True}, "free": {"full": False}, "foreign": {"onboard": (ID, 1)}},
    **{"deaf": {"uplink": False}, "mute": {"downlink": False}},
    "link": {"uplink": True, "downlink": True},
}
VERBS = {
    **{verb: verb for verb in ("hold", "resume", "pause")},
    **{"stop": "switch_off", "ack": "acknowledge", "due": "handle_deadline"},
}


def play(flight, script):
    """Carry out a script of actions: places, times [s], verbs, faults; "!" expects a refusal."""
    for action in script.split():
        if action.startswith("!"):
            with pytest.raises((ConflictError, UnavailableError)):
                play(flight, action[1:])
        elif action in PLACES:
            flight.step(position=PLACES[action], seconds=0.05)
        elif action[0].isdecimal():
            flight.step(seconds=float(action))
        elif action in SWITCHES:
            vars(flight).update(SWITCHES[action])
        elif action in ORDERS:
            flight.create(**ORDERS[action])
        elif action == "renew":
            flight.teleop.renew("m1", flight.now_ns)
        elif action == "change":
            flight.teleop.tell_link("the link has changed", flight.now_ns)
        elif action == "goto":
            flight.teleop.go_to(Leg(AWAY), flight.now_ns)
        elif action.startswith("cancel"):
            mission_id = action.removeprefix("cancel") or flight.newest.id
            flight.teleop.cancel(mission_id, flight.now_ns)
        elif action in VERBS:
            getattr(flight.teleop, VERBS[action])(flight.now_ns)
        elif action == "mark":
            flight.mark = len(flight.said)
        elif action == "guess":  # a predecessor's request had the same number by chance
            flight.mission = flight.requests[-1].number
        elif action == "stall":
            flight.now_ns += 4_000_000_000
            flight.see()
        else:
            do = {"cloud": "restart_cloud", "world": "restart", "restart": "restart_teleop"}
            getattr(flight, do.get(action, action))()


def asked(flight, since=0):
    """Requests since an index, without those that only carry progress."""
    return [r.request for r in flight.requests[since:] if r.request is not Request.PROGRESS]


LIMIT = 5.0
OPERATOR, READER = "operator-token-of-the-tests", "reader-token-of-the-tests"


A_MISSION = {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}
FAR = {"name": "far", "waypoints": [{"position_m": [0.5, -2.0, 1.0]}]}


class Running:
    """API, service and robot; `flight.position` is where the robot is."""

    def __init__(self, *, ready=True, unix=False, uplink=True):
        self.folder = TemporaryDirectory(prefix="cloudrc-")
        folder = Path(self.folder.name)
        for role, token in (("operator", OPERATOR), ("reader", READER)):
            (folder / role).write_text(token + "\n")
            (folder / role).chmod(0o600)
        self.token_file = folder / "operator"
        self.scene, self.bridge = load_scene("pipes"), Bridge()
        self.flight = ServiceFlight(self.scene)
        self.flight.uplink = uplink
        self.alarms, self.complaints, self.log = [], [], []
        self.bridge.alarm = lambda: self.alarms.append(time.monotonic())
        reader = RequestReader(PAPER.world.files, partial(build_plan, PAPER))
        app = create_app(self.bridge, reader, self.complaints.append)
        tokens = None if unix else Tokens(folder, self.complaints.append)
        self.gate = Gate(app, tokens, self.log.append)
        self.address = folder / "api.sock" if unix else ("127.0.0.1", 0)
        self.server = ApiServer(self.gate, self.bridge, self.address)
        self.url = self.server.url
        self.server.start()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._fly)
        if ready:
            self.bridge.open(self.flight.teleop)
        self._thread.start()
        self.until(lambda: self.server.started)

    def reset(self):
        """Begin again with another robot and service, and keep the server."""
        vars(self.bridge).pop("make_calls", None)
        self.bridge.overtakings = 0
        self.until(lambda: not self.gate._in_flight.total())
        for kept in (self.alarms, self.complaints, self.log, self.gate.counts):
            kept.clear()
        self.flight = ServiceFlight(self.scene)
        self.bridge.open(self.flight.teleop)

    @contextmanager
    def stalled(self):
        """Teleop's loop makes no calls, as while it waits for the disk."""
        make = self.bridge.make_calls
        self.bridge.make_calls = lambda now_ns: None
        yield
        self.bridge.make_calls = make

    def _fly(self):
        while not self._stopping.wait(0.002):
            if self.bridge.closed != STARTING:
                self.bridge.make_calls(self.flight.now_ns)
            self.flight.step()

    def stop(self):
        self.server.stop()
        self._stopping.set()
        self._thread.join(LIMIT)
        self.folder.cleanup()

    def get(self, path):
        return self.send(self.request(path))[1]

    def request(self, path, data=None, token=OPERATOR, method=None, headers=None):
        said = {"Authorization": f"Bearer {token}"} if token else {}
        headers = {**said, **(headers or {})}
        return HttpRequest(self.url + path, data, headers, method=method)

    def post(self, path, body=b"", token=OPERATOR):
        """Return the status and the answer of a POST; `body` may be bytes."""
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        return self.send(self.request(path, data, token, "POST"))

    def send(self, request):
        status, text = ask(request, LIMIT)
        return status, json.loads(text or "null")

    def logged(self):
        """Stop the server, and return the lines of its log."""
        self.server.stop()
        self.server.stop = lambda: None
        return self.log

    def until(self, condition):
        wait_until(condition, LIMIT)

    def fly(self, mission):
        """Post a mission and wait until it flies; return its id."""
        _, view = self.post("/v1/missions", mission)
        self.until(lambda: self.state_of(view["id"]) == "flying")
        return view["id"]

    def visit(self, mission_id, *points):
        """Move the robot to each point, once the mission has reached the point before."""
        self.until(lambda: self.state_of(mission_id) == "flying")  # from the spawn
        for count, point in enumerate(points, 1):
            self.flight.position = point
            path = f"/v1/missions/{mission_id}"
            self.until(lambda: len(self.get(path)["reached"]) >= count)  # noqa: B023

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
    with reuse_results():  # these tests read the same experiment again and again
        one = Running(**options)
        try:
            yield one
        finally:
            one.stop()


@pytest.fixture(scope="module")
def server():
    with running() as one:
        yield one


@pytest.fixture
def api(server):
    """The server of the module, with a robot and a service of the test's own."""
    server.reset()
    return server
