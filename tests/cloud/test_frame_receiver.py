# SPDX-License-Identifier: Apache-2.0

"""What cloud shows of a lossy stream of pictures: by hand, and against closed forms."""

from math import sqrt

import numpy as np
import pytest

from cloudrc.cloud.frame_receiver import WINDOW, FrameReceiver
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.wire.messages import Fragment
from cloudrc.wire.tunnel.codec import Kind

IMAGE = np.zeros((2, 2, 3), np.uint8)


class Decoder:
    """Decodes everything but "bad", and keeps what it was given."""

    def __init__(self):
        self.given = []

    def decode(self, data):
        self.given.append(data)
        return None if data == b"bad" else IMAGE


def receiver(keep=None):
    decoders = []
    made = FrameReceiver(lambda: decoders.append(Decoder()) or decoders[-1], 0.5, keep)
    return made, decoders


def fragments(number, count=1, *, key=False, data=b"."):
    return [Fragment(number * 100, number, n, count, key, data) for n in range(count)]


def numbers(made, *sent):
    """Return the numbers of the pictures that each fragment shows."""
    return [[frame.number for frame in made.receive(fragment, 7)] for fragment in sent]


KEY = {"key": True}


@pytest.mark.parametrize(
    ("sent", "shown"),
    [
        # Each stands alone: the newest counts, and what comes later than a newer one is old.
        ([(0, 1, KEY), (2, 1, KEY), (1, 1, KEY), (2, 1, KEY)], [[0], [2], [], []]),
        # Others need the one before: one that is late is waited for, and then all are shown.
        ([(0, 1, KEY), (2, 1, {}), (1, 1, {}), (3, 1, {})], [[0], [], [1, 2], [3]]),
        # One that never comes is a gap up to the next key frame.
        ([(0, 1, KEY), (2, 1, {}), (3, 1, {}), (4, 1, KEY), (5, 1, {})], [[0], [], [], [4], [5]]),
        ([(1, 1, {}), (2, 1, KEY), (1, 1, {})], [[], [2], []]),  # the first key frame is lost
        ([(0, 1, {**KEY, "data": b"bad"}), (1, 1, {}), (2, 1, KEY)], [[], [], [2]]),
    ],
)
def test_a_picture_is_shown_when_all_that_it_needs_is_there(sent, shown):
    made, _ = receiver()
    found = [fragments(number, count, **keys)[0] for number, count, keys in sent]
    assert numbers(made, *found) == shown


def test_the_last_piece_shows_a_picture_and_repeats_change_nothing():
    made, decoders = receiver()
    first, second, third = (
        each._replace(data=bytes([n])) for n, each in enumerate(fragments(0, 3, key=True))
    )
    (frame,) = [f for p in (third, first, third, first, second, second) for f in made.receive(p, 9)]
    assert (frame.stamp_ns, frame.number, frame.fovy) == (0, 0, 0.5)
    assert decoders[-1].given == [b"\0\1\2"]


def test_a_gap_takes_a_new_decoder_and_a_whole_stream_keeps_its_own():
    made, decoders = receiver()
    for number in (0, 1, 2, 3):
        made.receive(*fragments(number, key=number in (0, 2)), 7)
    assert len(decoders[-1].given) == 4
    made.receive(*fragments(9, key=True), 7)
    assert len(decoders[-1].given) == 1


def test_records_tell_when_the_last_piece_came_and_what_is_kept():
    made, _ = receiver(keep=lambda data, image: ("jpeg", data))
    made.begin_session(5)
    made.receive(*fragments(1), 20)
    made.receive(*fragments(0, key=True, data=b"x"), 30)
    told = made.take_records()
    assert [tuple(each) for each in told] == [
        *((30, 5, 0, 0, 0), (30, "jpeg", b"x")),
        *((30, 5, 1, 100, 10), (30, "jpeg", b".")),
    ]
    assert made.take_records() == []


def test_a_stream_without_its_key_frame_takes_little_memory():
    made, _ = receiver()
    for number in range(1, 1000):
        assert made.receive(*fragments(number), 7) == []
    assert len(made._begun) <= WINDOW + 1


def stream(groups, loss, count, key_count, group):
    """Return for each picture of a lossy link whether it was shown, shape (groups, group)."""
    link = LinkDirection(DirectionProfile(loss=loss), 3, True)
    made, counter, shown = receiver()[0], 0, np.zeros(groups * group, bool)
    for number in range(groups * group):
        is_key = number % group == 0
        for fragment in fragments(number, key_count if is_key else count, key=is_key):
            arrives = link.send(1, Kind.FRAME, counter, 1200, number)
            counter += 1
            for frame in made.receive(fragment, number) if arrives else ():
                shown[frame.number] = True
    return shown.reshape(groups, group)


@pytest.mark.parametrize(
    ("count", "key_count", "group", "loss", "expected"),
    [
        (4, 4, 1, 0.01, 0.99**4),
        (2, 10, 30, 0.01, 0.686),
        (3, 3, 30, 0.01, 0.648),
    ],
)
def test_the_share_of_pictures_shown_is_that_of_the_closed_form(
    count, key_count, group, loss, expected
):
    """q_K (1 - q^g) / (g (1 - q)): pictures of a group are not independent, so groups count."""
    q, q_key = (1 - loss) ** count, (1 - loss) ** key_count
    form = q_key * (1 - q**group) / (group * (1 - q))
    assert form == pytest.approx(expected, abs=5e-4)
    shares = stream(30_000 // group, loss, count, key_count, group).mean(axis=1)
    error = shares.std(ddof=1) / sqrt(len(shares))
    assert abs(shares.mean() - form) < 3 * error
