# SPDX-License-Identifier: Apache-2.0

"""Provide a control loop without endpoints, telemetry for it, and its commands."""

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.controllers.pid import build as pid
from cloudrc.cloud.estimators.running_mean import build as running_mean
from cloudrc.cloud.loop import ControlLoop
from cloudrc.cloud.predictors.last_sample import build as last_sample
from cloudrc.wire.messages import (
    NEVER_NS,
    UPRIGHT,
    ZERO,
    Command,
    GuardState,
    Odometry,
    Setpoint,
    Telemetry,
)

MS = 1_000_000
HERE = (1.0, 2.0, 3.0)
THERE = Setpoint((2.0, 2.0, 3.0))


def telemetry(stamp_ms, echo_ms=None, hold_ms=0):
    odometry = Odometry(round(stamp_ms * MS), HERE, UPRIGHT, ZERO, ZERO)
    echo_ns = NEVER_NS if echo_ms is None else echo_ms * MS
    return Telemetry(odometry.stamp_ns, odometry, (), echo_ns, hold_ms * MS, 0, 1, GuardState.TRACK)


def planned(at_ms, *xs):
    """Make a command whose plan begins at `at_ms` with the velocities `xs`, one per 10 ms."""
    first, *rest = ((x, 0.0, 0.0) for x in xs)
    return Command(at_ms * MS, 0, 0, first, 0.0, tuple(rest), at_ms * MS)


def loop(estimator=None, predictor=None, controller=None, heard_ms=None, echo_ms=None, **limits):
    """Return a loop, which has heard telemetry of 100 ms at `heard_ms`."""
    parts = estimator or running_mean, predictor or last_sample(), controller or pid()
    made = ControlLoop(*parts, **{"horizon_max": 1.0, "freeze_after": 0.4, **limits})
    if heard_ms is not None:
        made.observe(telemetry(100, echo_ms), heard_ms * MS)
    return made


def command(a_loop, now_ms):
    return a_loop.command(THERE, now_ms * MS, 0.01, 1, 0)


class Integrating(Controller):
    """A plug-in that counts its calls."""

    def __init__(self):
        self.asked = 0

    def update(self, estimate, setpoint, dt):
        self.asked += 1
        return ControlOutput((1.0, 0.0, 0.0), 0.5)
