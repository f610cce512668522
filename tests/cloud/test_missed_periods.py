"""When cloud reports missed periods, and when it reports them again."""

import pytest

from cloudrc.cloud.endpoint import MissedPeriods


def throttled(since, until, count=9):
    """Miss nine of ten periods of 10 ms, every 100 ms."""
    return [(tenth * 0.1, count) for tenth in range(round(since * 10), round(until * 10))]


@pytest.mark.parametrize(
    ("misses", "reports"),
    [
        ([(3.0, 50)], [3.0]),  # half a second
        (throttled(0.0, 60.0, count=5), [1.0]),  # half of the periods; reported once
        (throttled(3.0, 5.0) + throttled(20.0, 25.0), [3.6, 20.6]),
        ([(60.0 * minute, 3) for minute in range(3000)], []),  # a few a minute over days
    ],
)
def test_many_missed_periods_are_reported_once(misses, reports):
    periods = MissedPeriods(10_000_000)
    faults = [fault for at, count in misses for fault in periods.miss(count, round(at * 1e9))]
    assert [fault.stamp_ns * 1e-9 for fault in faults] == pytest.approx(reports, abs=0.15)
    assert not faults or faults[0].text.startswith("cloud sent no command in 5")
