# SPDX-License-Identifier: Apache-2.0

"""Numbers of the pictures of a flight, by hand."""

import pytest

from cloudrc.results.metrics import camera
from cloudrc.results.metrics.flight import SHIPPED
from cloudrc.results.record.columns import Recording
from cloudrc.wire.records import FrameSent, FrameShown

MS = 1_000_000
SECOND = 1000 * MS


class Flown:
    """A flight from 1 s to 2 s."""

    span_ns, end_ns = (SECOND, 2 * SECOND), 2 * SECOND

    def __init__(self, world, cloud):
        self.recording = Recording.from_records(world, cloud)

    def during(self, topic):
        columns = self.recording[topic].columns
        stamps_ns = columns["stamp_ns"]
        flown = (stamps_ns >= self.span_ns[0]) & (stamps_ns <= self.span_ns[1])
        return {name: values[flown] for name, values in columns.items()}


def sent(number, at_ms, psnr=40.0, size=1000):
    return FrameSent(at_ms * MS, 1, number, at_ms * MS, 0, number, 1, size, True, psnr)


def shown(number, taken_ms, at_ms):
    return FrameShown(at_ms * MS, 1, number, taken_ms * MS, 0)


def test_numbers_of_pictures_by_hand():
    world = [sent(0, 900), sent(1, 1100), sent(2, 1300, 30.0), sent(3, 1500, 35.0), sent(4, 1950)]
    cloud = [shown(0, 900, 1000), shown(1, 1100, 1200), shown(3, 1500, 1600)]
    flight = Flown(world, cloud)
    found = {name: SHIPPED[name].measure(flight) for name in ("frames_shown", "frame_psnr")}
    # The last one may be under way; the second one of the other three is lost.
    assert found == {"frames_shown": pytest.approx(2 / 3), "frame_psnr": 37.5}
    assert SHIPPED["video_kbit"].measure(flight) == pytest.approx(4 * 8.0)
    # From 100 to 300 ms, from 100 to 500 ms, from 100 to 500 ms.
    ages = camera.describe(camera.frame_ages(flight))
    assert ages["mean"] == pytest.approx((0.2 * 0.2 + 0.4 * 0.3 + 0.4 * 0.3) / 1.0)
    assert ages["max"] == pytest.approx(0.5)


def test_a_flight_without_pictures_has_no_such_numbers():
    flight = Flown([], [])
    names = [name for name in SHIPPED if name.startswith(("frame_", "frames_", "video_"))]
    assert len(names) == 7
    assert [SHIPPED[name].measure(flight) for name in names] == [None] * 7
