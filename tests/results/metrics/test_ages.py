# SPDX-License-Identifier: Apache-2.0

"""Ages at the actuator: computed by hand, and step by step."""

import numpy as np
import pytest

from cloudrc.results.metrics.flight import between
from cloudrc.wire.messages import ZERO, GuardState
from cloudrc.wire.records import CommandApplied, GuardChange, MissionEvent
from tests.results.metrics.conftest import Log, at, measured

# Begin and end of the use of each command, and stamp of its odometry, since the start [ms].
USED = [
    (0, 100, -50),
    (100, 140, 60),  # its predecessor was 150 ms old
    (140, 300, 50),  # overtaken: the age rises
    (300, 500, 250),  # 250 ms
    (700, 800, 660),  # ends a HOLD
    (800, 1000, 780),  # 140 ms
]
APPLIED = [(begin / 1000, basis / 1000) for begin, _, basis in USED]
CHANGES = [(0.0, GuardState.TRACK), (0.5, GuardState.HOLD), (0.7, GuardState.TRACK)]


def flight(applied, end, changes=CHANGES[:1], limit=None):
    """Make a flight of commands; `applied` and `changes` begin with their times [s]."""
    log = Log()
    log.world += [GuardChange(at(time), state, "") for time, state in changes]
    log.world += [
        CommandApplied(at(time), 1, n, at(basis), ZERO) for n, (time, basis) in enumerate(applied)
    ]
    log.cloud.append(MissionEvent(at(end), "done", 0, ""))
    return log.flight(age_deadline_s=limit)


def test_a_peak_is_the_age_just_before_a_command_that_lowers_it():
    peak = measured(flight(APPLIED, 1.0, CHANGES), "peak_age_mean")
    assert peak == pytest.approx((0.15 + 0.25 + 0.14) / 3)


@pytest.mark.parametrize("limit_ms", [60, 111.5, 198])
def test_ages_are_averages_over_the_time_with_a_command_in_use(limit_ms):
    ages = [(begin - basis, end - basis) for begin, end, basis in USED]
    time = sum(high - low for low, high in ages)
    above = sum(max(0, high - max(low, limit_ms)) for low, high in ages)
    mean = sum((high - low) * (high + low) / 2 for low, high in ages) / time
    found = flight(APPLIED, 1.0, CHANGES, limit_ms / 1000)
    assert measured(found, "age_violation") == pytest.approx(above / time)
    known = {"mean": mean / 1000, "max": 0.25, "p99": 0.25 - time / 2 / 100 / 1000}
    ages = {name: measured(found, f"age_at_actuator_{name}") for name in known}
    assert ages == pytest.approx(known)


@pytest.mark.parametrize(("limit", "misses"), [(0.25, 4), (0.235, 5), (0.1, 10), (None, 3)])
def test_the_worst_window_counts_periods_in_hold_and_those_with_a_late_command(limit, misses):
    held = [*CHANGES[:1], (0.47, GuardState.HOLD), (0.492, GuardState.TRACK)]
    found = flight(APPLIED[:4], 0.52, held, limit)
    assert measured(found, "misses_in_10") == misses


def test_without_a_limit_or_a_command_there_are_no_such_numbers():
    assert measured(flight(APPLIED, 1.0), "age_violation") is None
    for name in ("age_violation", "peak_age_mean"):
        assert measured(flight([], 1.0, limit=0.1), name) is None


@pytest.mark.parametrize("stamps", [[1, 2, 3, 4, 5], [4, 1, 5, 2, 3], [9, 9], []])
def test_the_rows_of_a_time_are_all_of_them_also_if_they_do_not_follow_each_other(stamps):
    stamps_ns = np.array(stamps, np.int64)
    found = between({"stamp_ns": stamps_ns, "value": 10 * stamps_ns}, 2, 4)
    wanted = [each for each in stamps if 2 <= each <= 4]
    assert found["stamp_ns"].tolist() == wanted
    assert found["value"].tolist() == [10 * each for each in wanted]
