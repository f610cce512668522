"""Loss and reordering from counters: computed by hand, and compared with a full count."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.exposition.parts import WINDOW, DatagramTally


def taken(counters, epoch=1):
    stream = DatagramTally()
    for counter in counters:
        stream.take(epoch, counter)
    return stream


@pytest.mark.parametrize(
    ("counters", "expected", "lost", "reordered"),
    [
        ([0, 2, *range(3, WINDOW + 1)], 1, 0, 0),  # only number 0 has left the window
        ([0, 2, *range(3, WINDOW + 2)], 2, 1, 0),
        ([0, 2, 1, *range(3, 2 * WINDOW)], WINDOW, 0, 1),
        ([0, 1, 1, 0, 2], 0, 0, 0),
        ([0, 1000, *range(1001, 1001 + WINDOW)], 1001, 999, 0),
    ],
    ids=["in the window", "left it", "late", "repeated", "a long silence"],
)
def test_losses_are_counted(counters, expected, lost, reordered):
    stream = taken(counters)
    assert (stream.expected, stream.lost, stream.reordered) == (expected, lost, reordered)


def test_a_new_epoch_starts_at_its_first_arrival():
    stream = taken(range(2 * WINDOW))
    for counter in range(1000, 1000 + WINDOW):
        stream.take(2, counter)
    assert (stream.expected, stream.lost) == (WINDOW, 0)


@given(seed=st.integers(0, 10_000), loss=st.floats(0, 0.9), jitter=st.integers(0, 60))
@settings(max_examples=40, deadline=None)
def test_counts_match_the_true_loss_and_reordering(seed, loss, jitter):
    rng, count = random.Random(seed), 400
    sent = [0] + [n for n in range(1, count) if rng.random() >= loss]
    sent[1:] = sorted(sent[1:], key=lambda n: n + rng.random() * jitter)
    stream = taken([*sent, *range(count, count + WINDOW)])
    newest, late = -1, 0
    for counter in sent:
        late += counter < newest
        newest = max(newest, counter)
    assert stream.expected == count
    assert stream.lost == count - len(sent)
    assert stream.reordered == late
