# SPDX-License-Identifier: Apache-2.0

"""The search for the range of values in which an answer is yes."""

import pytest

from cloudrc.studies.search import ValueRange, search


@pytest.mark.parametrize("present", [1, 7, 64, 100])
@pytest.mark.parametrize("limit", [1, 6, 7, 63, 64, 99])
def test_the_search_finds_each_border(present, limit):
    up = search(lambda number: number <= limit, present, 1, 100)
    assert up == ValueRange(1, limit, None, limit + 1, [])
    down = search(lambda number: number > limit, present, 1, 100)
    assert down == ValueRange(limit + 1, 100, limit, None, [])


def test_a_search_without_border_says_so():
    assert search(lambda number: True, 7, 1, 100) == ValueRange(1, 100, None, None, [])
    assert search(lambda number: False, 7, 1, 100) == ValueRange(None, None, None, 1, [])


def test_the_range_around_the_present_value_is_searched_and_others_are_told():
    found = search(lambda number: number in range(5, 31) or number >= 60, 12, 1, 100)
    assert found == ValueRange(5, 30, 4, 31, [(96, 100)])
