# SPDX-License-Identifier: Apache-2.0

"""A perception steers while the mission flies, with the newest scan, inside the fence."""

from math import inf, nan

import numpy as np
import pytest

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.cloud.perceiving import Here, Perceiver
from cloudrc.cloud.perceptions import Perception
from cloudrc.physics.geometry.fence import Fence
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry, RangeScan, Setpoint
from tests.cloud.conftest import MS

FENCE = Fence((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0))
FLYING = Setpoint((1.0, 1.0, 1.0), waypoint=3, epoch=7)


class Takes:
    """An emulated duration."""

    def __init__(self, duration_ms):
        self.duration_ns = duration_ms * MS

    def begin(self):
        pass

    def end(self, began_ns):
        return self.duration_ns


class Fake(Perception):
    """Goes to x = number of the call, or does what a test says."""

    def __init__(self):
        self.seen, self.resets, self.acts = [], 0, {}

    def reset(self):
        self.resets += 1

    def see(self, seen, odometry):
        self.seen.append((seen.stamp_ns // MS, odometry.stamp_ns // MS))
        act = self.acts.get(len(self.seen), Setpoint((0.1 * len(self.seen), 0.0, 1.0)))
        if isinstance(act, Exception):
            raise act
        return act


class Rig:
    """A perceiver whose scans need `duration_ms`, with what it does."""

    def __init__(self, duration_ms=0):
        self.perception, self.failures = Fake(), []
        worker = Here(Takes(duration_ms) if duration_ms else None)
        angles = np.array([-1.0, 0.0, 1.0])
        self.own = Perceiver(self.perception, worker, FENCE, angles, self.failures.append)
        self.own.begin_session()

    def hear(self, *stamps_ms, at_ms=None):
        for stamp_ms in stamps_ms:
            odometry = Odometry(stamp_ms * MS, ZERO, UPRIGHT, ZERO, ZERO)
            self.own.observe(odometry, (stamp_ms if at_ms is None else at_ms) * MS)

    def scan(self, stamp_ms, at_ms=None, rays=(1000, 0, 3000)):
        at_ms = stamp_ms if at_ms is None else at_ms
        self.own.receive_scan(RangeScan(stamp_ms * MS, rays), at_ms * MS)

    def steer(self, at_ms, given=FLYING):
        return self.own.steer(given, at_ms * MS)

    def x(self, at_ms, given=FLYING):
        return self.steer(at_ms, given).position[0]


def test_the_setpoint_has_teleops_marks_while_the_mission_flies():
    rig = Rig()
    rig.hear(0)
    assert rig.steer(1) is FLYING, "nothing is seen yet"
    rig.scan(2)
    steered = rig.steer(3)
    assert (steered.position, steered.waypoint, steered.epoch) == ((0.1, 0.0, 1.0), 3, 7)
    assert rig.steer(4) is steered, "the same object, so that nothing is computed again"
    hold = FLYING._replace(waypoint=-1)
    assert rig.steer(5, hold) is hold, "hold, drive, goto and the end win at once"
    assert rig.x(6) == 0.1
    rig.own.begin_mission()
    assert rig.steer(7) is FLYING
    rig.scan(8)
    assert (rig.x(9), rig.perception.resets) == (0.2, 2)
    rig.own.begin_session()
    assert rig.steer(10) is FLYING


def test_the_newest_that_has_arrived_is_next_and_the_others_are_dropped():
    rig = Rig(duration_ms=25)
    rig.hear(*range(0, 100, 10))
    for at_ms in (100, 110, 120):
        rig.scan(at_ms)
    assert rig.x(124) == 1.0, "teleop's, until the first is done"
    assert rig.x(125) == 0.1
    for at_ms in (130, 140):
        rig.scan(at_ms)
    assert rig.x(149) == 0.1
    assert rig.x(150) == 0.2
    assert rig.x(200) == pytest.approx(0.3)
    assert [stamp for stamp, _ in rig.perception.seen] == [100, 120, 140]
    assert rig.own.counts["seen_dropped"] == 2


def test_a_perception_gets_the_odometry_of_its_scan():
    rig = Rig()
    rig.scan(5)
    assert (rig.perception.seen, rig.own.counts["seen_dropped"]) == ([], 1), (
        "there is none that old"
    )
    rig.hear(0, 20, 30, at_ms=35)
    rig.hear(10, at_ms=36)  # late telemetry counts, too
    rig.scan(15, at_ms=37)
    rig.scan(29, at_ms=38)
    rig.hear(2100)
    rig.scan(9, at_ms=2101)
    assert rig.perception.seen == [(15, 10), (29, 20)], "2 s are kept"
    rig.scan(2100, at_ms=2102, rays=(1,))
    assert len(rig.perception.seen) == 2, "another robot's"


def test_odometry_of_the_very_instant_of_a_scan_is_that_of_the_scan():
    rig = Rig()
    rig.hear(0, 10)
    rig.scan(10)
    assert rig.perception.seen == [(10, 10)]


def test_what_a_perception_returns_is_judged():
    rig = Rig()
    rig.hear(0)
    acts = [Setpoint((9.0, -9.0, 9.0), yaw=1.0), None, ZERO, Setpoint((nan, 0.0, 0.0))]
    acts += [Setpoint(ZERO, velocity=(inf, 0.0, 0.0)), ValueError("no wall")]
    rig.perception.acts = dict(enumerate(acts, start=1))
    for at_ms in range(1, 7):
        rig.scan(at_ms)
        steered = rig.steer(at_ms)
        assert (steered.position, steered.yaw) == ((1.8, -1.8, 1.8), 1.0), "the last good one stays"
    assert [*map(type, rig.failures)] == [*[InvalidValueError] * 3, ValueError]


def test_records_say_when_a_scan_was_taken_arrived_begun_done_and_acted_on():
    rig = Rig(duration_ms=25)
    rig.hear(0)
    rig.scan(100, at_ms=130)
    rig.scan(110, at_ms=140)
    rig.own.note_command(rig.steer(150), 7, 1, 150 * MS)
    assert rig.own.take_records() == [], "no command has followed"
    rig.own.note_command(rig.steer(160), 7, 2, 160 * MS)
    rig.own.note_command(rig.steer(170), 7, 3, 170 * MS)
    rig.perception.acts[3] = None
    rig.scan(180)
    rig.own.note_command(rig.steer(190), 7, -1, 190 * MS)  # withheld
    rig.own.note_command(rig.steer(200), 7, 4, 200 * MS)
    rig.steer(210)
    rows = [
        (each.seen_stamp_ns, each.wait_ns, each.compute_ns, each.hold_ns, each.stamp_ns)
        for each in rig.own.records
    ]
    assert [[value // MS for value in row] for row in rows] == [
        [100, 0, 25, 5, 160],
        [110, 15, 25, 20, 200],
        [180, 0, 25, 5, 210],
    ]
    assert [each.counter for each in rig.own.records] == [2, 4, -1]


def test_what_is_seen_in_one_mission_does_not_steer_the_next():
    rig = Rig(duration_ms=25)
    rig.hear(0)
    rig.scan(100)
    rig.own.begin_mission()
    assert rig.steer(130) is FLYING
    assert rig.perception.resets == 1
