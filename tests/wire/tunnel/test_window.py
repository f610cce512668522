# SPDX-License-Identifier: Apache-2.0

"""Channels, compared with a set that remembers every counter."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.wire.tunnel.window import LATE, REPEATED, USED, WINDOW, ReceiveWindow


def expected(counter, seen, newest_wins):
    newest = max(seen, default=-1)
    if counter in seen or newest - counter >= WINDOW:
        return REPEATED
    return LATE if newest_wins and counter < newest else USED


def compare(counters, newest_wins):
    window, seen = ReceiveWindow(newest_wins), set[int]()
    for counter in counters:
        assert window.take(counter) == expected(counter, seen, newest_wins)
        seen.add(counter)


@pytest.mark.parametrize("ahead", [WINDOW - 1, WINDOW, WINDOW + 1, 2**64 - 4])
def test_the_window_ends_where_it_says(ahead):
    compare((3, 3 + ahead, 3, 4, 3 + ahead), newest_wins=True)


def test_a_plan_is_late_after_a_newer_command_in_any_order():
    window = ReceiveWindow(newest_wins=False)
    assert [window.take(n, newest_wins=True) for n in (3, 2, 2, 4)] == [
        *("used", "late", "repeated", "used"),
    ]
    assert window.take(1) == "used"


@given(st.lists(st.integers(0, 40) | st.integers(1000, 1070), max_size=60), st.booleans())
@settings(max_examples=200, deadline=None)
def test_the_window_agrees_with_a_set(counters, newest_wins):
    compare(counters, newest_wins)


def test_more_repeated_than_new_datagrams_are_a_flood():
    window = ReceiveWindow(newest_wins=True)
    flooded = []
    for counter in (0, 1, 0, 1, 0, 2, 2):  # a link that doubles everything, and more
        window.take(counter)
        flooded.append(window.is_flooded)
    assert flooded == [False, False, False, False, True, False, True]
    window.reset()
    assert not window.is_flooded
    assert window.take(0) == USED, "a new epoch forgets all counters"
