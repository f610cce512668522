# SPDX-License-Identifier: Apache-2.0

"""The growth of counters, which go on from mission to mission, in a part of a recording."""

import pytest

from cloudrc.results.metrics.counters import growth
from cloudrc.results.record.columns import Recording
from cloudrc.wire.records import Counted

SECOND = 1_000_000_000
FLIGHT = 10 * SECOND, 20 * SECOND


def counted(totals):
    """Record the totals of a counter by their times [s]."""
    rows = [Counted(round(at * SECOND), "cloud", "gaps", total) for at, total in totals.items()]
    return Recording.from_records([], [*rows, Counted(0, "cloud", "others", 9)])


@pytest.mark.parametrize(
    ("totals", "expected"),
    [
        ({1.0: 400, 9.0: 400, 25.0: 400}, 0),
        ({9.5: 0, 10.5: 10, 19.5: 10, 20.5: 20}, 10),  # evenly between two records
        ({10.5: 10, 11.5: 10}, 5),  # and began to rise a second before it
        ({10.0: 5, 12.0: 7, 13.0: 3, 20.0: 4}, 6),  # its process restarts
        ({}, None),
    ],
)
def test_only_what_a_counter_rose_in_the_flight_counts(totals, expected):
    assert growth(counted(totals), "gaps", FLIGHT) == expected


@pytest.mark.parametrize(
    ("totals", "expected"),
    [
        ({10.5: 7, 12.5: 207, 19.5: 907}, 1000),
        ({10.2: 50, 10.21: 51, 19.6: 990}, 1000),  # two records beside each other say little
        ({15.0: 3}, None),
    ],
)
def test_a_steady_counter_rises_before_and_after_its_records_too(totals, expected):
    assert growth(counted(totals), "gaps", FLIGHT, steady=True) == expected


def test_without_a_time_the_whole_recording_counts():
    assert growth(counted({1.0: 4, 2.0: 6, 3.0: 1}), "gaps", None) == 7
