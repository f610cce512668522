"""Cloud's missed periods: when they are told, and when again."""

from cloudrc.cloud.endpoint import MissedPeriods

MS, S = 1_000_000, 1_000_000_000


def told(missed: list[tuple[float, int]]) -> list[float]:
    """When it says something [s], of periods missed at instants [s]."""
    missed = MissedPeriods()
    return [
        fault.stamp_ns / S for at, count in missed for fault in missed.miss(count, round(at * S))
    ]


def throttled(since: float, until: float) -> list[tuple[float, int]]:
    """Nine of ten periods of 10 ms missed, every 100 ms."""
    return [(tenth * 0.1, 9) for tenth in range(round(since * 10), round(until * 10))]


def test_one_stall_of_half_a_second_is_told_and_a_shorter_one_is_not():
    assert told([(3.0, 50)]) == [3.0]
    assert told([(3.0, 49)]) == []


def test_it_is_told_once_however_long_it_lasts():
    (at,) = told(throttled(3.0, 60.0))
    assert 3.5 <= at <= 3.7


def test_it_is_told_again_once_it_has_kept_up_for_ten_seconds():
    first, second = told(throttled(3.0, 5.0) + throttled(20.0, 25.0))
    assert (3.5 <= first <= 3.7, 20.5 <= second <= 20.7) == (True, True)
    assert len(told(throttled(3.0, 5.0) + throttled(14.0, 25.0))) == 1


def test_what_gathers_over_days_is_no_fault():
    assert told([(60.0 * minute, 3) for minute in range(3000)]) == []
    assert told([(0.25 * n, 1) for n in range(10_000)]) == []


def test_half_of_the_periods_missed_is_told_within_two_seconds():
    (at,) = told([(tenth * 0.1, 5) for tenth in range(100)])
    assert at < 1.3


def test_it_says_how_many_were_missed():
    missed = MissedPeriods()
    missed.miss(40, 5 * S)
    assert missed.miss(30, 5 * S + 100 * MS)[0].text.startswith(
        "cloud sent no command in 70 periods of"
    )
