"""Records of cloud, as the tap sends them, and an API that a test answers."""

import time
from math import nan

import pytest

from cloudrc.errors import BadInputError
from cloudrc.geometry.scene import Scene
from cloudrc.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.records import Control, TelemetrySent

LIMIT = 120.0
"""Time limit for what has no number of its own [s]: a browser without a graphics card is slow."""


def wait_for(condition):
    """Return how long it takes until the condition holds [s]."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < LIMIT
        time.sleep(0.02)
    return time.monotonic() - began


def control(at, basis=0.0, **fields):
    """Make the record of a control period at `at` on odometry of `basis` [s]."""
    still = dict.fromkeys(Control._fields, ZERO)
    still |= dict.fromkeys(("measured", "position", "setpoint"), (0.0, 0.0, 1.0))
    still |= {"stamp_ns": round(at * 1e9), "basis_stamp_ns": round(basis * 1e9)}
    still |= {"epoch": 1, "counter": 1, "horizon": 0.0, "rtt": nan, "loop_delay": nan}
    still |= {"orientation_wxyz": UPRIGHT, "waypoint": 0, "yaw_rate": 0.0}
    return Control(**{**still, **fields})


def told(at, position=(0.0, 0.0, 1.0), velocity=ZERO, **fields):
    """Make the record of telemetry of `at` [s]."""
    odometry = Odometry(round(at * 1e9), position, UPRIGHT, velocity, ZERO)
    whole = {"echo_stamp_ns": -1, "echo_hold_ns": 0, "slip_ns": 0, "mission": 0, "touch_speed": 0.0}
    whole |= {"stamp_ns": odometry.stamp_ns, "odometry": odometry, "tip_force": 0.0}
    telemetry = Telemetry(**{**whole, "guard": GuardState.TRACK, **fields})
    return TelemetrySent(telemetry.stamp_ns, 0, 0, telemetry)


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
