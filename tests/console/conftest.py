"""Statuses of the robot, as teleop's API sends them, and an API that a test answers."""

from math import nan

import pytest

from cloudrc.errors import BadInputError
from cloudrc.geometry.scene import Scene
from cloudrc.messages import UPRIGHT, ZERO, GuardState
from cloudrc.records import Control
from cloudrc.teleop.wire import RobotStatus

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
