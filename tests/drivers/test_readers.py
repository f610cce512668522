# SPDX-License-Identifier: Apache-2.0

"""Readers of cloud's records: each gets all records, or knows how many it has lost."""

import pytest

from cloudrc.drivers.readers import RecordReader, RecordSender
from cloudrc.records import Arrival, Fault
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
