"""Loss and reordering from counters: computed by hand, and compared with a full count."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.exposition.parts import WINDOW, DatagramTally


def taken(*counters: int, epoch: int = 1) -> DatagramTally:
    stream = DatagramTally()
    for counter in counters:
        stream.take(epoch, counter)
    return stream


def test_a_datagram_counts_after_it_leaves_the_window() -> None:
    stream = taken(0, 2, *range(3, WINDOW + 1))
    assert (stream.expected, stream.lost) == (1, 0)  # only number 0 has left the window
    stream.take(1, WINDOW + 1)
    assert (stream.expected, stream.lost) == (2, 1)


def test_a_late_datagram_is_reordered_not_lost() -> None:
    stream = taken(0, 2, 1, *range(3, 2 * WINDOW))
    assert (stream.lost, stream.reordered) == (0, 1)


def test_a_repeated_datagram_does_not_count() -> None:
    stream = taken(0, 1, 1, 0, 2)
    assert (stream.lost, stream.reordered) == (0, 0)


def test_a_new_epoch_starts_at_its_first_arrival() -> None:
    stream = taken(*range(2 * WINDOW))
    for counter in range(1000, 1000 + WINDOW):
        stream.take(2, counter)
    assert (stream.expected, stream.lost) == (WINDOW, 0)


def test_datagrams_of_a_long_silence_are_lost() -> None:
    stream = taken(0, 1000, *range(1001, 1001 + WINDOW))
    assert (stream.expected, stream.lost) == (1001, 999)


@given(seed=st.integers(0, 10_000), loss=st.floats(0, 0.9), jitter=st.integers(0, 60))
@settings(max_examples=40, deadline=None)
def test_counts_match_the_true_loss_and_reordering(seed: int, loss: float, jitter: int) -> None:
    rng, count = random.Random(seed), 400
    sent = [0] + [n for n in range(1, count) if rng.random() >= loss]
    sent[1:] = sorted(sent[1:], key=lambda n: n + rng.random() * jitter)
    stream = taken(*sent, *range(count, count + WINDOW))
    newest, late = -1, 0
    for counter in sent:
        late += counter < newest
        newest = max(newest, counter)
    assert stream.expected == count
    assert stream.lost == count - len(sent)
    assert stream.reordered == late
