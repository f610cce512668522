# SPDX-License-Identifier: Apache-2.0

"""Pictures are cut into fragments, and a picture that is due too early is late."""

from collections import Counter

import numpy as np
import pytest

from cloudrc.config.camera import CameraConfig
from cloudrc.wire.endpoint import Outcome
from cloudrc.wire.messages import FRAGMENT_MAX
from cloudrc.wire.pictures import EncodedFrame
from cloudrc.world.frame_source import FrameSource

IMAGE = np.zeros((2, 2, 3), np.uint8)


class Camera:
    config = CameraConfig(name="front", fps=30)

    def aim(self):
        pass

    def render(self):
        return IMAGE


class Codec:
    def encode(self, image):
        return EncodedFrame(b"data", True)

    def decode(self, data):
        return IMAGE


class Slow:
    """A worker that is done when the test says so."""

    def __init__(self):
        self.call, self.done = None, False

    def begin(self, call, now_ns):
        self.call, self.done = call, False

    def take(self):
        return Outcome(self.call(), None, 10, 15) if self.done else None


def source(worker=None):
    counts = Counter()
    return FrameSource(Camera(), lambda: (Codec(), Codec()), worker, counts), counts


@pytest.mark.parametrize("size", [1, FRAGMENT_MAX, FRAGMENT_MAX + 1, 5000])
def test_a_picture_is_cut_into_fragments_that_make_it_again(size):
    data = bytes(k % 251 for k in range(size))
    cut = [*EncodedFrame(data, True, 5, 3).fragments()]
    assert b"".join(each.data for each in cut) == data
    assert {(each.stamp_ns, each.number, each.fragments, each.key) for each in cut} == {
        (5, 3, len(cut), True)
    }
    assert [each.fragment for each in cut] == [*range(len(cut))]
    assert max(len(each.data) for each in cut) <= FRAGMENT_MAX


def test_without_a_worker_a_picture_takes_no_time():
    made, counts = source()
    for now_ns in (10, 20):
        made.take(now_ns)
        picture = made.finished()
        assert (picture.stamp_ns, picture.encode_ns) == (now_ns, 0)
    assert (picture.number, made.finished(), counts["frames_late"]) == (1, None, 0)
    made.begin_session()
    made.take(30)
    assert made.finished().number == 0


def test_a_picture_that_is_due_while_one_is_rendered_is_late():
    worker = Slow()
    made, counts = source(worker)
    made.take(10)
    assert made.finished() is None
    made.take(20)
    assert counts["frames_late"] == 1
    worker.done = True
    assert made.finished()[2:4] == (10, 0)
    made.take(30)
    worker.done = True
    picture = made.finished()
    assert (picture.stamp_ns, picture.number, picture.encode_ns) == (30, 1, 5)


def test_a_picture_of_an_earlier_session_is_not_sent():
    worker = Slow()
    made, _ = source(worker)
    made.take(10)
    made.begin_session()
    worker.done = True
    assert made.finished() is None
    made.take(20)
    worker.done = True
    assert made.finished()[2:4] == (20, 0)


def test_a_failure_of_the_renderer_ends_the_flight():
    worker = Slow()
    made, _ = source(worker)
    made.take(10)
    worker.take = lambda: Outcome(None, RuntimeError("GL"), 0, 0)
    with pytest.raises(RuntimeError, match="GL"):
        made.finished()
