"""Readers of cloud's records: each gets all records, or knows how many it has lost."""

import pytest

from cloudrc.drivers.readers import RecordReader, RecordSender
from cloudrc.messages import ZERO, Odometry, Telemetry
from cloudrc.messages import GuardState as Guard
from cloudrc.records import Arrival, Fault, TelemetrySent

ODOMETRY = Odometry(7, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), ZERO, ZERO)
TELEMETRY = Telemetry(7, ODOMETRY, (), -1, 0, 0, 0, Guard.TRACK)


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
    sender.see(1, 4, TELEMETRY)
    sender.put([arrival(1), Fault(2, "late", "a\nb")])
    sent = TelemetrySent(7, 1, 4, TELEMETRY)
    got = reader.take(0)
    assert [*map(str, got[:1])] == [str(sent)]  # a touch speed of NaN equals nothing
    assert got[1:] == [arrival(1), Fault(2, "late", "a\nb")]
    assert got[0].telemetry.guard is Guard.TRACK
    assert (reader.take(0), reader.dropped) == ([], 0)


def test_a_slow_reader_knows_how_many_records_it_has_lost(sender, reader):
    for number in range(10_000):
        sender.put([arrival(number)])
    got = len(reader.take(0))
    assert 0 < got < 10_000
    sender.put([arrival(-1)])
    assert reader.take(0) == [arrival(-1)]
    assert got + reader.dropped == 10_000
