# SPDX-License-Identifier: Apache-2.0

"""Let a perception look at what has arrived, on a core of its own, and steer by its setpoints.

One thing is looked at at a time, the newest that has arrived. What arrives meanwhile waits, and the
next to arrive takes its place. So a slow perception sees fewer scans or pictures, not older ones.
"""

from __future__ import annotations

from bisect import insort
from collections import Counter
from collections.abc import Callable
from functools import partial
from math import nan
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.outside.code import attempt
from cloudrc.base.outside.values import RESULT, InvalidValueError, shorten
from cloudrc.cloud.compute_time import ComputeTime
from cloudrc.cloud.perceptions import Frame, Perception, Scan
from cloudrc.cloud.results import to_vector
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.rays import ranges_of
from cloudrc.wire.endpoint import Outcome, Worker
from cloudrc.wire.messages import Odometry, RangeScan, Setpoint, Vector
from cloudrc.wire.records import UNSENT, Perceived
from cloudrc.wire.tunnel.session import NO_EPOCH

HISTORY_NS = 2_000_000_000
"""Time for which odometry is kept, to find that of the time at which a scan was taken [ns]."""
NOWHERE: Vector = (nan, nan, nan)


class Here:
    """A worker of virtual time: each call is over at once."""

    def __init__(self, duration: ComputeTime | None) -> None:
        """Let each call have this emulated duration; None: no time."""
        self._duration = duration
        self._outcome: Outcome | None = None

    def begin(self, call: Callable[[], Any], now_ns: int) -> None:
        """Call; the emulated duration begins at `now_ns`."""
        if self._duration is not None:
            self._duration.begin()
        result, error = attempt(call)
        lasts_ns = 0 if self._duration is None else self._duration.end(now_ns)
        self._outcome = Outcome(result, error, now_ns, now_ns + lasts_ns)

    def take(self) -> Outcome | None:
        """Return the outcome once."""
        outcome, self._outcome = self._outcome, None
        return outcome


def judge(result: Any, low: Vector, high: Vector) -> Setpoint:
    """Return the setpoint that a perception made, in the box from `low` to `high` [m].

    Raises:
        InvalidValueError: If it is none, or has numbers that are not finite.
    """
    if not isinstance(result, Setpoint):
        raise InvalidValueError(f"its result is {shorten(result)}, not a Setpoint")
    x, y, z = (
        min(max(value, least), most)
        for value, least, most in zip(
            to_vector(result.position, "position"), low, high, strict=True
        )
    )
    return Setpoint(
        (x, y, z),
        RESULT.of(result.yaw, "yaw"),
        velocity=to_vector(result.velocity, "velocity"),
        turns=bool(result.turns),
        yaw_rate=RESULT.of(result.yaw_rate, "yaw rate"),
    )


class _Input(NamedTuple):
    """A scan or picture at which the perception looks or is about to."""

    seen: Scan | Frame
    arrived_ns: int  # cloud's clock
    mission: int = 0  # number of the mission in which the look has begun


class Perceiver:
    """Gives a perception what arrives, and replaces teleop's setpoints by its own.

    Attributes:
        records: What became of the things seen, until `take_records`.
        counts: Name of an event -> how often it has happened. A pod has no metric of them: it shows
            fewer than 200 series.
    """

    def __init__(
        self,
        perception: Perception,
        worker: Worker,
        fence: Fence,
        angles: NDArray[np.float64],
        note_failure: Callable[[BaseException], None],
    ) -> None:
        """Connect the parts; setpoints are brought into the inner box of `fence`.

        `angles` are those of the rays of a scan [rad], which its datagrams do not have.
        """
        self._angles = angles
        self._perception, self._worker = perception, worker
        self._low, self._high = fence.inner_low, fence.inner_high
        self._note_failure = note_failure
        self.records, self.counts = list[Perceived](), Counter(seen_dropped=0)
        self._mission, self._is_fresh = 0, True
        self._odometry = list[Odometry]()  # that has arrived, oldest first
        self._waiting: _Input | None = None
        self._looking: _Input | None = None
        self._outcome: Outcome | None = None  # of `_looking`, even if it is over later
        self._setpoint: Setpoint | None = None
        self._steered: Setpoint | None = None  # the same, with teleop's marks
        self._news: Perceived | None = None  # no command has followed from it so far

    def begin_session(self) -> None:
        """Forget all measurements: world's clock may be another one."""
        self._odometry.clear()
        self._waiting = None
        self.begin_mission()

    def begin_mission(self) -> None:
        """Forget all setpoints; the perception is reset before it looks again."""
        self._mission += 1
        self._is_fresh = True
        self._setpoint = self._steered = self._news = None

    def observe(self, odometry: Odometry, now_ns: int) -> None:
        """Keep odometry that arrived at `now_ns` [ns], cloud's clock."""
        self.advance(now_ns)
        insort(self._odometry, odometry, key=attrgetter("stamp_ns"))
        if self._odometry[-1].stamp_ns - self._odometry[0].stamp_ns > HISTORY_NS:
            del self._odometry[0]

    def receive_scan(self, scan: RangeScan, now_ns: int) -> None:
        """Look at a scan that arrived at `now_ns` [ns], cloud's clock, at once or later."""
        # Else world has another robot.
        if self._perception.takes == "scan" and len(scan.millimetres) == len(self._angles):
            ranges = ranges_of(scan.millimetres)
            self.receive(Scan(scan.stamp_ns, ranges, self._angles), now_ns)

    def receive_frame(self, frame: Frame, now_ns: int) -> None:
        """Look at a picture that was shown at `now_ns` [ns], cloud's clock, at once or later."""
        if self._perception.takes == "camera":
            self.receive(frame, now_ns)

    def receive(self, seen: Scan | Frame, now_ns: int) -> None:
        """Look at something that arrived at `now_ns` [ns], cloud's clock, at once or later."""
        self.advance(now_ns)
        if self._waiting is not None:
            self._drop()
        self._waiting = _Input(seen, now_ns)
        self._begin(now_ns)

    def advance(self, now_ns: int) -> None:
        """Do what is due up to `now_ns` [ns], cloud's clock."""
        while self._looking is not None:
            if self._outcome is None:
                self._outcome = self._worker.take()
            if self._outcome is None or self._outcome.done_ns > now_ns:
                return
            outcome, given = self._outcome, self._looking
            self._outcome = self._looking = None
            self._finish(given, outcome, now_ns)
            self._begin(outcome.done_ns)

    def steer(self, given: Setpoint, now_ns: int) -> Setpoint:
        """Return the setpoint at `now_ns` [ns], cloud's clock: teleop's, `given`, or the own one.

        The own one counts while the mission flies to a waypoint.
        """
        self.advance(now_ns)
        if self._setpoint is None or given.waypoint < 0:
            return given
        marks, steered = (given.waypoint, given.epoch), self._steered
        if steered is None or (steered.waypoint, steered.epoch) != marks:
            steered = self._setpoint._replace(waypoint=given.waypoint, epoch=given.epoch)
            self._steered = steered
        return steered

    def note_command(self, steered: Setpoint, epoch: int, counter: int, now_ns: int) -> None:
        """Note that a command for a setpoint of `steer` left at `now_ns` [ns], cloud's clock."""
        if self._news is not None and steered is self._steered and counter != UNSENT:
            self._record(self._news._replace(epoch=epoch, counter=counter), now_ns)
            self._news = None

    def take_records(self) -> list[Perceived]:
        """Return the records made since the last call."""
        records, self.records = self.records, []
        return records

    def _begin(self, now_ns: int) -> None:
        """Begin with what waits at `now_ns` [ns], if the perception is free."""
        if self._waiting is None or self._looking is not None:
            return
        given, self._waiting = self._waiting, None
        stamp_ns = given.seen.stamp_ns
        known = [each for each in self._odometry if each.stamp_ns <= stamp_ns]
        if not known:  # telemetry is late, or lost
            self._drop()
            return
        self._looking = given._replace(mission=self._mission)
        is_fresh, self._is_fresh = self._is_fresh, False
        self._worker.begin(partial(self._see, given.seen, known[-1], reset=is_fresh), now_ns)

    def _drop(self) -> None:
        self.counts.update(seen_dropped=1)

    def _see(self, seen: Scan | Frame, odometry: Odometry, *, reset: bool) -> Setpoint | None:
        """Let the perception look, in whichever thread; judge what it returns."""
        if reset:
            self._perception.reset()
        result = self._perception.see(seen, odometry)
        return None if result is None else judge(result, self._low, self._high)

    def _finish(self, given: _Input, outcome: Outcome, now_ns: int) -> None:
        """Take over the setpoint of a look that is over, unless another mission flies."""
        setpoint: Setpoint | None = outcome.result
        if outcome.error is not None:
            self._note_failure(outcome.error)
        begun_ns, done_ns = outcome.begun_ns, outcome.done_ns
        times = begun_ns - given.arrived_ns, done_ns - begun_ns, done_ns
        place = NOWHERE if setpoint is None else setpoint.position
        made = Perceived(0, given.seen.stamp_ns, *times, NO_EPOCH, UNSENT, place)
        if setpoint is None or given.mission != self._mission:
            self._record(made, now_ns)
            return
        if self._news is not None:  # teleop steers meanwhile
            self._record(self._news, now_ns)
        self._setpoint, self._steered, self._news = setpoint, None, made

    def _record(self, made: Perceived, now_ns: int) -> None:
        """Record at `now_ns` [ns]; up to then `hold_ns` has the end of the look."""
        self.records.append(made._replace(stamp_ns=now_ns, hold_ns=now_ns - made.hold_ns))
