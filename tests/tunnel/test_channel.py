"""Channels, compared with a set that remembers every counter."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.tunnel.channel import LATE, REPEATED, USED, WINDOW, Channel


def expected(counter, seen, newest_wins):
    newest = max(seen, default=-1)
    if counter in seen or newest - counter >= WINDOW:
        return REPEATED
    return LATE if newest_wins and counter < newest else USED


def compare(counters, newest_wins):
    channel, seen = Channel(newest_wins), set[int]()
    for counter in counters:
        assert channel.take(counter) == expected(counter, seen, newest_wins)
        seen.add(counter)


@pytest.mark.parametrize("ahead", [WINDOW - 1, WINDOW, WINDOW + 1, 2**64 - 4])
def test_the_window_ends_where_it_says(ahead):
    compare((3, 3 + ahead, 3, 4, 3 + ahead), newest_wins=True)


@given(st.lists(st.integers(0, 40) | st.integers(900, 1100), max_size=60), st.booleans())
@settings(max_examples=80, deadline=None)
def test_the_window_agrees_with_a_set(counters, newest_wins):
    compare(counters, newest_wins)


def test_more_that_is_repeated_than_sent_is_a_flood():
    channel = Channel(newest_wins=True)
    flooded = []
    for counter in (0, 1, 0, 1, 0, 2, 2):  # a link that doubles everything, and more
        channel.take(counter)
        flooded.append(channel.is_flooded)
    assert flooded == [False, False, False, False, True, False, True]
    channel.reset()
    assert not channel.is_flooded
    assert channel.take(0) == USED, "a new epoch forgets all counters"


STRIDES = (1, 93)
"""Steps between sixteen counters; the second spans more than the window: 15 * 93 > 1024."""


def explore(depth, newest_wins, stride):
    """Try every sequence of `depth` out of 16 counters, each prefix once; return their number."""
    channel, checked = Channel(newest_wins), 0

    def step(level, seen):
        nonlocal checked
        before = channel._newest, channel._seen
        for counter in range(0, 16 * stride, stride):
            assert channel.take(counter) == expected(counter, seen, newest_wins)
            if level + 1 < depth:
                step(level + 1, seen | {counter})
            else:
                checked += 1
            channel._newest, channel._seen = before

    step(0, frozenset())
    return checked


@pytest.mark.parametrize("newest_wins", [True, False])
@pytest.mark.parametrize("depth", [4, pytest.param(6, marks=pytest.mark.full)])
def test_every_short_sequence_agrees_with_a_set(newest_wins, depth, figure):
    assert all(explore(depth, newest_wins, stride) == 16**depth for stride in STRIDES)
    text = f"replay window, sequences of {depth} of 16 counters: unlike a set"
    figure(text, 0, "==", 0, count=16**depth)
