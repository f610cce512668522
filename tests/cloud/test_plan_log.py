# SPDX-License-Identifier: Apache-2.0

"""What the plan in use had predicted for the instant of an odometry."""

import pytest

from cloudrc.cloud.plan_log import PlanLog
from cloudrc.wire.messages import ZERO, Command
from cloudrc.wire.records import PlanFollowed
from tests.cloud.conftest import MS, telemetry


@pytest.fixture
def log():
    """Provide the plans of two commands, along x and along y, that begin at 100 and 110 ms."""
    log = PlanLog()
    for stamp, axis in ((50, 0), (60, 1)):
        path = [tuple(0.1 * k * (axis == each) for each in range(3)) for k in range(4)]
        begin = (stamp + 50) * MS
        log.add(Command(stamp * MS, 0, 0, ZERO, 0.0, (ZERO,) * 3, begin), path)
    return log


@pytest.mark.parametrize(
    ("at_ms", "x"),
    [(95, 0.0), (100, 0.0), (104, 0.04), (110, 0.1), (125, 0.25), (129.999999, 0.3), (130, None)],
)
def test_between_its_steps_a_plan_predicts_the_position_until_it_ends(log, at_ms, x):
    place = pytest.approx((x, 0.0, 0.0))
    expected = None if x is None else PlanFollowed(7, round(at_ms * MS), place)
    assert log.look_up(telemetry(at_ms, 50), 7) == expected


def test_the_plan_is_that_of_the_echoed_command(log):
    assert log.look_up(telemetry(115, 60), 0).position == pytest.approx((0.0, 0.05, 0.0))
    assert log.look_up(telemetry(115, 50), 0) is None, "older commands are not followed again"
    assert log.look_up(telemetry(115, 55), 0) is None, "a command without a plan"
