# SPDX-License-Identifier: Apache-2.0

"""Readers of cloud's records: each gets all records, or knows how many it has lost."""

import numpy as np
import pytest

from cloudrc.flight.pod.readers import RecordReader, RecordSender
from cloudrc.wire.pictures import Jpeg
from cloudrc.wire.records import Arrival, Fault, FrameKept
from tests.support.told import told


def arrival(number):
    return Arrival(number, True, 1, number, 0.05, True)


@pytest.fixture
def sender(tmp_path):
    sender = RecordSender(tmp_path)
    yield sender
    sender.close()


@pytest.fixture
def reader(tmp_path, sender):
    reader = RecordReader(tmp_path)
    sender.put([])
    yield reader
    reader.close()


def test_a_reader_gets_records_and_telemetry_in_order(sender, reader):
    sent, fault = told(7)._replace(counter=4), Fault(2, "late", "a\nb")
    sender.see(1, 4, sent.telemetry)
    sender.put([arrival(1), fault])
    assert repr(reader.take(0)) == repr([sent, arrival(1), fault])  # with the types of all values
    assert (reader.take(0), reader.dropped) == ([], 0)


def test_a_slow_reader_knows_how_many_records_it_has_lost(sender, reader):
    for number in range(10_000):
        sender.put([arrival(number)])
    got = len(reader.take(0))
    assert 0 < got < 10_000
    sender.put([arrival(-1)])
    assert reader.take(0) == [arrival(-1)]
    assert got + reader.dropped == 10_000


@pytest.mark.parametrize(("side", "shown"), [(64, 64), (1024, 128)])
def test_a_picture_comes_with_the_stamp_of_its_time_and_in_a_size_that_fits(
    sender, reader, side, shown
):
    """One of pure noise is as large as a picture can be."""
    image = np.random.default_rng(1).integers(0, 256, (side, side, 3), np.uint8)
    sender.show_picture(7, image)
    (picture,) = reader.take(0)
    assert (picture.stamp_ns, picture.format) == (7, "jpeg")
    assert Jpeg().decode(picture.data).shape == (shown, shown, 3)


def test_a_reader_may_want_pictures_alone(tmp_path, sender):
    reader = RecordReader(tmp_path, (FrameKept,))
    sender.put([])
    sender.put([arrival(1), FrameKept(1, "png", b"kept")])
    sender.show_picture(7, np.zeros((16, 16, 3), np.uint8))
    assert [record.stamp_ns for record in reader.take(0)] == [7], "kept ones are not sent twice"
    assert reader.dropped == 0
    reader.close()
