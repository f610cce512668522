"""What the plan in use had predicted for the instant of an odometry."""

import pytest

from cloudrc.cloud.plan_log import PlanLog
from cloudrc.messages import UPRIGHT, ZERO, Command, GuardState, Odometry, Telemetry
from cloudrc.records import PlanFollowed

MS = 1_000_000


@pytest.fixture
def log():
    """Provide the plans of two commands, along x and along y, that begin at 100 and 110 ms."""
    log = PlanLog()
    for stamp, axis in ((50, 0), (60, 1)):
        path = [tuple(0.1 * k * (axis == each) for each in range(3)) for k in range(4)]
        begin = (stamp + 50) * MS
        log.add(Command(stamp * MS, 0, 0, ZERO, 0.0, (ZERO,) * 3, begin), path)
    return log


def told(at_ms, echo_ms):
    odometry = Odometry(round(at_ms * MS), ZERO, UPRIGHT, ZERO, ZERO)
    return Telemetry(odometry.stamp_ns, odometry, (), echo_ms * MS, 0, 0, 1, GuardState.TRACK)


@pytest.mark.parametrize(
    ("at_ms", "x"),
    [(95, 0.0), (100, 0.0), (104, 0.04), (110, 0.1), (125, 0.25), (129.999999, 0.3), (130, None)],
)
def test_between_its_steps_a_plan_predicts_the_position_until_it_ends(log, at_ms, x):
    found = log.look_up(told(at_ms, 50), 7)
    if x is None:
        assert found is None
    else:
        assert found == PlanFollowed(7, round(at_ms * MS), pytest.approx((x, 0.0, 0.0)))


def test_the_plan_is_that_of_the_echoed_command(log):
    assert log.look_up(told(115, 60), 0).position == pytest.approx((0.0, 0.05, 0.0))
    assert log.look_up(told(115, 50), 0) is None, "older commands are not followed again"
    assert log.look_up(told(115, 55), 0) is None, "a command without a plan"
