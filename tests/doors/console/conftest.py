# SPDX-License-Identifier: Apache-2.0

"""Sessions with a console, statuses of the robot, and an API that a test answers."""

import subprocess
import sys
from argparse import Namespace
from contextlib import contextmanager, suppress
from math import nan

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli import console
from cloudrc.physics.geometry.scene import Scene
from cloudrc.results.under_way import under_way
from cloudrc.teleop.client import Api, ApiError
from cloudrc.teleop.wire import RobotStatus
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState
from cloudrc.wire.records import Control
from tests.conftest import wait_until

LIMIT = 120.0
"""Time limit for what has no number of its own [s]: a browser without a graphics card is slow."""


def control(at, basis=0.0, **fields):
    """Make the record of a control period at `at` on odometry of `basis` [s]."""
    still = dict.fromkeys(Control._fields, ZERO)
    still |= dict.fromkeys(("measured", "position", "setpoint"), (0.0, 0.0, 1.0))
    still |= {"stamp_ns": round(at * 1e9), "basis_stamp_ns": round(basis * 1e9)}
    still |= {"epoch": 1, "counter": 1, "horizon": 0.0, "rtt": nan, "loop_delay": nan}
    still |= {"orientation_wxyz": UPRIGHT, "waypoint": 0, "yaw_rate": 0.0}
    return Control(**{**still, **fields})


def status(at, position=(0.0, 0.0, 1.0), control=None, **fields):
    """Make a status of the robot from telemetry of `at` [s]."""
    known = {"epoch": 1, "mission": 0, "guard": GuardState.TRACK, "stamp_ns": round(at * 1e9)}
    return RobotStatus(position=position, control=control, **{**known, **fields})


def start(folder, *words):
    """Start a command of cloudrc in `folder`; return the process."""
    command = [sys.executable, "-m", "cloudrc", *map(str, words)]
    kinds = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=folder, **kinds)


def answers(api):
    """Return the newest telemetry in the API's answer; False if nobody answers."""
    try:
        return api.get("/v1/state")["seen"]
    except Exception:
        return False


def beside(folder, monkeypatch):
    """Let commands find the flight of a session in `folder`, and no other."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))


@contextmanager
def session_with_console(tmp_path_factory, *flags):
    """Fly a session of the hover: yield its API, the run's folder, and the console's process.

    `flags` are those of the console, which has to end with the session. Only commands with the
    environment of `beside` find the flight.
    """
    folder = tmp_path_factory.mktemp("session")
    with pytest.MonkeyPatch.context() as patch:
        beside(folder, patch)
        session = start(folder, "up", "hover", "--set", "link.profile=wifi")
        wait_until(lambda: under_way() or session.poll() is not None)
        ((run, url),) = under_way().items()
        api = Api(url)
        wait_until(lambda: answers(api))
        patch.setenv("BROWSER", "echo opens %s")
        shown = start(folder, "console", run, *flags)
    yield api, run, shown
    session.terminate()
    said, _ = shown.communicate(timeout=LIMIT)
    assert shown.returncode == 0, said
    session.communicate(timeout=LIMIT)


def in_pod(file, robot=None, token_file=None):
    """Return what the console of a pod shows, whose experiment and profile are a file."""
    about = {"config": file, "profile": file, "api": "http://127.0.0.1:1"}
    return console._in_pod(Namespace(**about, robot=robot, token_file=token_file, records=None))


def acknowledge(api):
    """Acknowledge a stop, and again while the API says that the stop is still on its way."""

    def is_accepted():
        with suppress(ApiError):
            api.post("/v1/acknowledge")
            return True
        return False

    wait_until(is_accepted)


class FakeApi:
    """Keeps all requests; refuses the paths in `refused`."""

    def __init__(self):
        self.posted, self.refused, self.answers = [], {}, {}

    def get(self, path):
        return self.answers[path]

    def post(self, path, body=None):
        self.posted.append((path, body))
        if path in self.refused:
            raise BadInputError(self.refused[path])


@pytest.fixture
def api():
    return FakeApi()


@pytest.fixture
def nowhere():
    """A scene without obstacles."""
    return Scene("empty")
