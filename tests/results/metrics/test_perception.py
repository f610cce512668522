# SPDX-License-Identifier: Apache-2.0

"""The age at which the robot acts on a scan, by hand."""

import pytest

from cloudrc.results.metrics.perception import acted
from cloudrc.results.record.columns import Recording
from cloudrc.wire.records import CommandApplied, Perceived

ZERO = (0.0, 0.0, 0.0)


class Flown:
    """Tables of a flight that lasts as long as its recording."""

    def __init__(self, world, cloud):
        recording = Recording.from_records(world, cloud)
        self.during = lambda topic: recording[topic].columns


def perceived(stamp_ns, counter, epoch=1):
    return Perceived(0, stamp_ns, 0, 0, 0, epoch, counter, ZERO)


def applied(now_ns, counter, epoch=1):
    return CommandApplied(now_ns, epoch, counter, 0, ZERO)


@pytest.mark.parametrize(
    ("cloud", "world", "found"),
    [
        ([perceived(10, 4)], [applied(30, 3), applied(40, 4), applied(50, 5)], {10: 40}),
        ([perceived(10, 4)], [applied(50, 5)], {10: 50}),  # the first command is lost
        ([perceived(10, 4), perceived(20, 6)], [applied(60, 6)], {20: 60}),  # replaced before
        ([perceived(10, -1, 0), perceived(20, 6)], [applied(60, 6)], {20: 60}),  # no setpoint
        ([perceived(10, 4)], [applied(60, 1, epoch=2)], {}),
        ([perceived(10, 4)], [], {}),
        ([perceived(10, 5)], [applied(50, 6), applied(60, 5)], {10: 60}),  # arrival wins
    ],
)
def test_the_robot_acts_with_the_first_command_from_the_setpoint(cloud, world, found):
    seen, acting = acted(Flown(world, cloud))
    pairs = zip(seen["seen_stamp_ns"].tolist(), acting["stamp_ns"].tolist(), strict=True)
    assert dict(pairs) == found
