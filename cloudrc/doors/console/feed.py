# SPDX-License-Identifier: Apache-2.0

"""Store what a console shows of a flight: the newest pose, the charts of the last 25 s, the trail.

The input is the robot's status from teleop's API. If world and cloud share a clock, the delay of
the downlink is the newest round trip minus the delay of the uplink.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import dist, hypot, inf, nan
from typing import Any

import numpy as np

from cloudrc.physics.geometry.clearance import NO_SIZE, Array, Spheres, clearance
from cloudrc.physics.geometry.obstacles import Obstacle
from cloudrc.results.metrics.definitions import CHARTED, Echoes, PredictionJudge
from cloudrc.teleop.wire import RobotStatus
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import Control

WINDOW = 25.0
"""Time that the charts show [s]."""
STALE = 0.5
"""Age above which a value is too old to be shown [s]."""
TRAIL_STEP = 0.02
"""Shortest distance between two points of the trail [m]."""
TRAIL_MAX = 4000
"""Largest number of points of the trail; older points are dropped."""
JUMP = 0.5
"""Distance between two poses above which a new trail begins, because the robot was reset [m]."""


TIME, UPLINK, DOWNLINK, ESTIMATE, ERROR, SPEED, CHARTED_FROM = range(7)
"""Rows of `FlightFeed.columns`: time of arrival on the console's clock, one-way delays, delay by
which cloud predicts ahead [s], distance from predicted to measured position [m], speed [m/s], and
from there on the values of `CHARTED`, each in its unit."""


class FlightFeed:
    """The present state of a flight, from the statuses of the robot that teleop sends.

    Attributes:
        status: The robot's newest status; None before the first.
        samples: Values of all charts at one time each, oldest first; unknown values are NaN.
        flown: Number of points added so far to the trail, the line that shows the robot's path.
    """

    def __init__(self, known: Sequence[Obstacle] = (), hull: Spheres | None = None) -> None:
        """Begin without a status; measure the clearance of the robot's `hull` from obstacles.

        `known` are the obstacles. Without a hull the clearance is infinite.
        """
        self._obstacles, self._robot = () if hull is None else known, hull or NO_SIZE
        self._judge, self._echoes = PredictionJudge(), Echoes()
        self.status: RobotStatus | None = None
        self.samples: deque[list[float]] = deque()
        self.flown = 0
        # Times of the newest control period, judged prediction and echo [s].
        self._controlled = self._judged = self._echoed = -inf
        self._downlink = nan
        self._trail: deque[tuple[float, ...]] = deque(maxlen=TRAIL_MAX)  # position and clearance

    def take(self, status: RobotStatus | None, now: float) -> None:
        """Store the robot's status that has arrived at `now` [s], unless it is old or None."""
        last = self.status
        if status is None or (last and last.stamp_ns == status.stamp_ns):
            return
        self.status = status
        if last is None or last.epoch != status.epoch:
            self._judge.reset()
            self._judged = -inf
        control, before = status.control, last and last.control
        if control and (before is None or before.stamp_ns != control.stamp_ns):
            self._take_control(control, status.uplink_delay, now)
        self._follow(status, last)
        self.samples.append(self._sample(status, now))
        while self.samples[0][TIME] < now - WINDOW:
            self.samples.popleft()

    def control(self, now: float) -> Control | None:
        """Return cloud's last command; None if it is old at `now` [s] or the robot is grounded."""
        status = self.status
        if status is None or status.guard is GuardState.GROUND or now - self._controlled >= STALE:
            return None
        return status.control

    def trail(self) -> tuple[Array, Array]:
        """Return the flown path [m], shape (n, 3), and the clearances on it [m], shape (n,)."""
        rows = np.array(self._trail, dtype=np.float64).reshape(-1, 4)
        return rows[:, :3], rows[:, 3]

    def columns(self) -> Array:
        """Return every third sample of the charts, shape (values, n).

        The times are relative to the newest returned sample [s].
        """
        rows = np.array([*self.samples][::3] or [[0.0] + [nan] * (SPEED + len(CHARTED))])
        rows[:, TIME] -= rows[-1, TIME]
        return np.ascontiguousarray(rows.T)

    def _take_control(self, control: Control, uplink_delay: float, now: float) -> None:
        self._controlled, judged = now, self._judge.judged
        self._judge.take(control)
        if self._judge.judged > judged:
            self._judged = now
        if self._echoes.take(control.rtt, control.loop_delay):
            self._echoed = now
            self._downlink = control.rtt - uplink_delay

    def _follow(self, status: RobotStatus, last: RobotStatus | None) -> None:
        """Add the robot's position to the trail; begin a new trail after a reset of the robot."""
        position = status.position
        if last is not None and dist(position, last.position) > JUMP:
            self._trail.clear()
        if not self._trail or dist(position, self._trail[-1][:3]) > TRAIL_STEP:
            near = clearance(self._obstacles, [position], [status.orientation_wxyz], self._robot)
            self._trail.append((*position, float(near[0])))
            self.flown += 1

    def _sample(self, status: RobotStatus, now: float) -> list[float]:
        sample = [now, *(nan,) * ERROR, hypot(*status.velocity), *(nan,) * len(CHARTED)]
        sample[UPLINK] = status.uplink_delay
        if (control := self.control(now)) is None:
            return sample
        sample[ESTIMATE] = control.horizon
        if now - self._echoed < STALE:
            sample[DOWNLINK] = self._downlink
        if now - self._judged < STALE:
            sample[ERROR] = hypot(*self._judge.error)
        sample[CHARTED_FROM:] = [_size(quantity.value(control)) for quantity in CHARTED]
        return sample


def _size(value: Any) -> float:
    """Return the length of a vector, or the number itself, in its unit."""
    return hypot(*value) if isinstance(value, tuple) else float(value)
