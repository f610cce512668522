"""Channels, compared with a set that remembers every counter."""

from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.tunnel.channel import LATE, REPEATED, USED, WINDOW, Channel


def test_newest_wins_and_the_last_to_arrive_wins():
    newest, arrival = Channel(newest_wins=True), Channel(newest_wins=False)
    order = [0, 2, 1, 2, 3]
    used, late, repeated = USED, LATE, REPEATED
    assert [newest.take(n) for n in order] == [used, used, late, repeated, used]
    assert [arrival.take(n) for n in order] == [used, used, used, repeated, used]


@pytest.mark.parametrize("newest_wins", [True, False])
def test_the_window_ends_where_it_says(newest_wins):
    channel = Channel(newest_wins)
    channel.take(WINDOW)
    assert channel.take(1) == (LATE if newest_wins else USED)
    assert channel.take(0) == REPEATED
    assert channel.take(1) == REPEATED


def test_a_jump_to_the_edge_of_the_window_keeps_what_is_in_it():
    channel = Channel(newest_wins=True)
    for counter in (0, 1, 2):
        channel.take(counter)
    channel.take(WINDOW)  # 0 is out, 1 and 2 are in
    assert [channel.take(n) for n in (1, 2, 3)] == [REPEATED, REPEATED, LATE]
    channel.take(WINDOW + 2)
    assert channel.take(2) == REPEATED
    assert channel.take(WINDOW + 1) == LATE


@pytest.mark.parametrize("ahead", [WINDOW - 1, WINDOW, WINDOW + 1, 2**64 - 4])
def test_a_jump_over_the_window_forgets_what_was_before(ahead):
    channel = Channel(newest_wins=True)
    channel.take(3)
    assert channel.take(3 + ahead) == USED
    assert channel.take(3) == REPEATED  # seen, or too old to know
    assert channel.take(4) == (LATE if ahead <= WINDOW else REPEATED)
    assert channel.take(3 + ahead) == REPEATED


def test_a_new_epoch_forgets_all_counters():
    channel = Channel(newest_wins=True)
    channel.take(9)
    channel.reset()
    assert channel.take(0) == USED


def test_more_that_is_repeated_than_sent_is_a_flood():
    channel = Channel(newest_wins=True)
    for counter in (0, 1, 0, 1):  # a link that doubles everything
        channel.take(counter)
    assert not channel.is_flooded
    channel.take(0)
    assert channel.is_flooded
    channel.take(2)
    assert not channel.is_flooded
    channel.take(2)
    channel.reset()
    assert not channel.is_flooded


def expected(counter, seen, newest_wins):
    if counter in seen:
        return REPEATED
    return LATE if newest_wins and seen and counter < max(seen) else USED


@given(st.lists(st.integers(0, 40), max_size=60), st.booleans())
@settings(max_examples=80, deadline=None)
def test_the_window_agrees_with_a_set(counters, newest_wins):
    channel, seen = Channel(newest_wins), set()
    for counter in counters:
        assert channel.take(counter) == expected(counter, seen, newest_wins)
        seen.add(counter)


STRIDE = 93
"""Step between sixteen counters, so that they span more than the window: 15 * 93 > 1024."""


def explore(depth, newest_wins, stride):
    """Try every sequence of `depth` out of 16 counters, each prefix once; return their number."""
    counters = [n * stride for n in range(16)]
    channel, checked = Channel(newest_wins), 0

    def step(level, seen, newest):
        nonlocal checked
        before = channel._newest, channel._seen
        for counter in counters:
            outcome = channel.take(counter)
            if counter in seen or newest - counter >= WINDOW:
                assert outcome == REPEATED
            else:
                assert outcome == (LATE if newest_wins and counter < newest else USED)
            if level + 1 < depth:
                step(level + 1, seen | {counter}, max(newest, counter))
            else:
                checked += 1
            channel._newest, channel._seen = before

    step(0, frozenset(), -1)
    return checked


@pytest.mark.parametrize(("newest_wins", "stride"), list(product([True, False], [1, STRIDE])))
def test_every_short_sequence_agrees_with_a_set(newest_wins, stride):
    assert explore(4, newest_wins, stride) == 16**4


def test_every_sequence_of_five_agrees_with_a_set(figure):
    assert explore(5, True, 1) == 16**5
    figure("replay window, sequences of 5 of 16 counters: unlike a set", 0, "==", 0, count=16**5)


@pytest.mark.full
@pytest.mark.parametrize("newest_wins", [True, False])
@pytest.mark.parametrize("stride", [1, STRIDE])
def test_every_sequence_of_six_agrees_with_a_set(newest_wins, stride, figure):
    assert explore(6, newest_wins, stride) == 16**6
    figure("replay window, sequences of 6 of 16 counters: unlike a set", 0, "==", 0, count=16**6)
