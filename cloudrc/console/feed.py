"""Store what a console shows of a flight: the newest pose, the charts of the last 25 s, the trail.

The input is the records that cloud sends to the tap, a UNIX socket. If world and cloud share a
clock, the delay of the downlink is the newest round trip minus the delay of the uplink.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from math import dist, hypot, inf, nan
from typing import NamedTuple

import numpy as np

from cloudrc.exposition.parts import PredictionJudge
from cloudrc.geometry.clearance import Array, clearance
from cloudrc.geometry.scene import Scene
from cloudrc.messages import NEVER_NS, GuardState, Telemetry
from cloudrc.records import Arrival, Control, Record, SessionOpened, TelemetrySent

WINDOW = 25.0
"""Time that the charts show [s]."""
STALE = 0.5
"""Age above which a record is too old to be shown [s]."""
TRAIL_STEP = 0.02
"""Shortest distance between two points of the trail [m]."""
TRAIL_MAX = 4000
"""Largest number of points of the trail; older points are dropped."""
JUMP = 0.5
"""Distance between two poses above which a new trail begins, because the robot was reset [m]."""


class Sample(NamedTuple):
    """The values of all charts at one time; unknown values are NaN."""

    time: float  # of arrival [s], the console's clock
    uplink: float = nan  # one-way delay [s]
    downlink: float = nan  # one-way delay [s]
    estimate: float = nan  # delay by which cloud predicts ahead [s]
    error: float = nan  # distance from measured position to setpoint [m]
    prediction_error: float = nan  # distance from predicted to measured position [m]
    speed: float = nan  # [m/s]


class FlightFeed:
    """The present state of a flight, from the records that cloud sends to the console.

    Attributes:
        telemetry: The newest telemetry; None before the first.
        control: The newest record of a command that cloud computed; None before the first.
        samples: Points of the charts, oldest first.
        flown: Number of points added so far to the trail, the line that shows the robot's path.
    """

    def __init__(self, scene: Scene) -> None:
        """Begin without records; measure the clearance from the pipes of `scene`."""
        self._scene, self._judge = scene, PredictionJudge()
        self.telemetry: Telemetry | None = None
        self.control: Control | None = None
        self.samples: deque[Sample] = deque()
        self.flown = 0
        # Times of the newest telemetry, control period, judged prediction and echo [s].
        self._heard = self._controlled = self._judged = self._echoed = -inf
        self._uplink = self._downlink = self._rtt = nan
        self._trail: deque[tuple[float, ...]] = deque(maxlen=TRAIL_MAX)  # position and clearance

    def take(self, records: Iterable[Record], now: float) -> None:
        """Take the records of the newest datagrams, oldest first; `now` is the arrival time [s]."""
        news = False
        for record in records:
            if isinstance(record, Arrival):
                self._uplink = record.delay
            elif isinstance(record, Control):
                self._take_control(record, now)
            elif isinstance(record, TelemetrySent):
                news |= self._take_telemetry(record.telemetry, now)
            elif isinstance(record, SessionOpened):
                self._judge.reset()
                self._judged = -inf
        if news:
            self.samples.append(self._sample(now))
        while self.samples and self.samples[0].time < now - WINDOW:
            self.samples.popleft()

    def silence(self, now: float) -> float:
        """Return the time from the newest telemetry to `now` [s]; infinite before the first."""
        return now - self._heard

    def command_age(self, now: float) -> float:
        """Return the age of the last applied command at `now` [s]; infinite if none."""
        told = self.telemetry
        if told is None or told.echo_stamp_ns == NEVER_NS:
            return inf
        return told.echo_hold_ns * 1e-9 + self.silence(now)

    def controls(self, now: float) -> bool:
        """Return whether cloud controls the robot at `now` [s]; False for a robot on the ground."""
        grounded = self.telemetry is not None and self.telemetry.guard == GuardState.GROUND
        return now - self._controlled < STALE and not grounded

    def trail(self) -> tuple[Array, Array]:
        """Return the flown path [m], shape (n, 3), and the clearances on it [m], shape (n,)."""
        rows = np.array(self._trail, dtype=np.float64).reshape(-1, 4)
        return rows[:, :3], rows[:, 3]

    def columns(self, step: int = 3) -> Array:
        """Return every `step`-th sample of the charts, shape (fields of `Sample`, n).

        The times are relative to the newest returned sample [s]. Unknown values are NaN.
        """
        rows = np.array([*self.samples][::step] or [Sample(0.0)], dtype=np.float64)
        rows[:, 0] -= rows[-1, 0]
        return np.ascontiguousarray(rows.T)

    def _take_control(self, control: Control, now: float) -> None:
        self.control, self._controlled, judged = control, now, self._judge.judged
        self._judge.take(control)
        if self._judge.judged > judged:
            self._judged = now
        if control.rtt != self._rtt:  # a new echo
            self._rtt, self._echoed = control.rtt, now
            self._downlink = control.rtt - self._uplink

    def _take_telemetry(self, telemetry: Telemetry, now: float) -> bool:
        """Store telemetry; return False if it has the same stamp as the last telemetry."""
        last, self.telemetry = self.telemetry, telemetry
        if last is not None and last.stamp_ns == telemetry.stamp_ns:
            return False
        self._heard, position = now, telemetry.odometry.position
        if last is not None and dist(position, last.odometry.position) > JUMP:
            self._trail.clear()
        if not self._trail or dist(position, self._trail[-1][:3]) > TRAIL_STEP:
            near = clearance(self._scene, [position], [telemetry.odometry.orientation_wxyz])
            self._trail.append((*position, float(near[0])))
            self.flown += 1
        return True

    def _sample(self, now: float) -> Sample:
        assert self.telemetry is not None
        speed = hypot(*self.telemetry.odometry.velocity)
        control = self.control
        if control is None or not self.controls(now):
            return Sample(now, self._uplink, speed=speed)
        judged, echoed = now - self._judged < STALE, now - self._echoed < STALE
        return Sample(
            now,
            self._uplink,
            self._downlink if echoed else nan,
            control.horizon,
            dist(control.setpoint, control.measured),
            hypot(*self._judge.error) if judged else nan,
            speed,
        )
