"""Channels, compared with a set that remembers every counter."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.tunnel.channel import LATE, REPEATED, USED, WINDOW, Channel


@pytest.mark.parametrize("newest_wins", [True, False])
def test_the_window_ends_where_it_says(newest_wins: bool) -> None:
    channel = Channel(newest_wins)
    channel.take(WINDOW)
    assert channel.take(1) == (LATE if newest_wins else USED)
    assert channel.take(0) == REPEATED
    assert channel.take(1) == REPEATED


@pytest.mark.parametrize("ahead", [WINDOW - 1, WINDOW, WINDOW + 1, 2**64 - 4])
def test_a_jump_over_the_window_forgets_what_was_before(ahead: int) -> None:
    channel = Channel(newest_wins=True)
    channel.take(3)
    assert channel.take(3 + ahead) == USED
    assert channel.take(3) == REPEATED  # seen, or too old to know
    assert channel.take(4) == (LATE if ahead <= WINDOW else REPEATED)
    assert channel.take(3 + ahead) == REPEATED


def test_more_that_is_repeated_than_sent_is_a_flood() -> None:
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
    assert channel.take(0) == USED, "a new epoch forgets all counters"


def expected(counter: int, seen: set[int] | frozenset[int], newest_wins: bool) -> str:
    newest = max(seen, default=-1)
    if counter in seen or newest - counter >= WINDOW:
        return REPEATED
    return LATE if newest_wins and counter < newest else USED


@given(st.lists(st.integers(0, 40) | st.integers(900, 1100), max_size=60), st.booleans())
@settings(max_examples=80, deadline=None)
def test_the_window_agrees_with_a_set(counters: list[int], newest_wins: bool) -> None:
    channel, seen = Channel(newest_wins), set[int]()
    for counter in counters:
        assert channel.take(counter) == expected(counter, seen, newest_wins)
        seen.add(counter)


STRIDES = (1, 93)
"""Steps between sixteen counters; the second spans more than the window: 15 * 93 > 1024."""


def explore(depth: int, newest_wins: bool, stride: int) -> int:
    """Try every sequence of `depth` out of 16 counters, each prefix once; return their number."""
    channel, checked = Channel(newest_wins), 0

    def step(level: int, seen: frozenset[int]) -> None:
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
def test_every_short_sequence_agrees_with_a_set(
    newest_wins: bool, depth: int, figure: Callable[..., None]
) -> None:
    assert all(explore(depth, newest_wins, stride) == 16**depth for stride in STRIDES)
    text = f"replay window, sequences of {depth} of 16 counters: unlike a set"
    figure(text, 0, "==", 0, count=16**depth)
