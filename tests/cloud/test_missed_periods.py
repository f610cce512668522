"""When cloud reports missed periods, and when it reports them again."""

from cloudrc.cloud.endpoint import MissedPeriods

MS, S = 1_000_000, 1_000_000_000


def reported(misses: list[tuple[float, int]]) -> list[float]:
    """Return when faults come [s], for misses given as (instant [s], number of periods)."""
    periods = MissedPeriods()
    return [
        fault.stamp_ns / S for at, count in misses for fault in periods.miss(count, round(at * S))
    ]


def throttled(since: float, until: float) -> list[tuple[float, int]]:
    """Miss nine of ten periods of 10 ms, every 100 ms."""
    return [(tenth * 0.1, 9) for tenth in range(round(since * 10), round(until * 10))]


def test_a_stall_of_half_a_second_is_reported_a_shorter_one_not():
    assert reported([(3.0, 50)]) == [3.0]
    assert reported([(3.0, 49)]) == []


def test_a_long_stall_is_reported_once():
    (at,) = reported(throttled(3.0, 60.0))
    assert 3.5 <= at <= 3.7


def test_a_stall_is_reported_again_after_ten_good_seconds():
    first, second = reported(throttled(3.0, 5.0) + throttled(20.0, 25.0))
    assert (3.5 <= first <= 3.7, 20.5 <= second <= 20.7) == (True, True)
    assert len(reported(throttled(3.0, 5.0) + throttled(14.0, 25.0))) == 1


def test_a_few_misses_a_minute_over_days_are_no_fault():
    assert reported([(60.0 * minute, 3) for minute in range(3000)]) == []
    assert reported([(0.25 * n, 1) for n in range(10_000)]) == []


def test_missing_half_of_the_periods_is_reported_within_2_s():
    (at,) = reported([(tenth * 0.1, 5) for tenth in range(100)])
    assert at < 1.3


def test_the_report_says_how_many_periods_were_missed():
    periods = MissedPeriods()
    periods.miss(40, 5 * S)
    (fault,) = periods.miss(30, 5 * S + 100 * MS)
    assert fault.text.startswith("cloud sent no command in 70 periods of")
